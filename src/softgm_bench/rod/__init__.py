"""The Cosserat rod: physics only, no reinforcement learning."""
