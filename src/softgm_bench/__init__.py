"""Reference benchmark for distributed control of soft robotic arms."""

__version__ = "0.1.0"
