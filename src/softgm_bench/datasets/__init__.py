"""Data sets of transitions: whole episodes of policies in files that TorchRL maps into memory; ``docs/datasets.md``."""
