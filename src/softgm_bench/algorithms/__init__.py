"""Algorithms: how a batch of frames improves a model."""
