"""Loggers beside the run folder's own files: W&B and TensorBoard, kept apart from the run by ``guarded.Loggers``."""
