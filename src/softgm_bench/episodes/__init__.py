"""The episodes that policies play: evaluation, recording, recorded trajectories, and their simulation again."""
