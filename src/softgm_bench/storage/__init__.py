"""Files: where those of a run lie, how one is written whole, which versions wrote it."""
