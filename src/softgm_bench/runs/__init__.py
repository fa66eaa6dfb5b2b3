"""One run: the loop, its folder, checkpoints and resuming, metrics, loggers, settings of the machine."""
