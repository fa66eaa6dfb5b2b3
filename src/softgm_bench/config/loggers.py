"""Settings of the loggers; values and their meaning in ``conf/logger``."""

from dataclasses import dataclass

MODES = ("online", "offline", "disabled")


@dataclass
class WandbConfig:
    """Weights & Biases."""

    mode: str | None
    project: str
    entity: str | None
    video: bool

    def __post_init__(self) -> None:
        """Refuse what there is not.

        Raises:
            ValueError: with one line naming the key, its value and what would be right.
        """
        if self.mode is not None and self.mode not in MODES:
            raise ValueError(f"logger.wandb.mode={self.mode}: choose one of {', '.join(MODES)}, or null")
        if not self.project:
            raise ValueError("logger.wandb.project is empty: name a project")


@dataclass
class TensorboardConfig:
    """TensorBoard."""

    flush_seconds: int

    def __post_init__(self) -> None:
        """Refuse what makes no sense.

        Raises:
            ValueError: with one line naming the key, its value and what would be right.
        """
        if self.flush_seconds < 1:
            raise ValueError(f"logger.tensorboard.flush_seconds={self.flush_seconds}: it must be at least 1")


@dataclass
class LoggerConfig:
    """Loggers beside the run folder's own files; None: not that one."""

    csv: bool = True
    wandb: WandbConfig | None = None
    tensorboard: TensorboardConfig | None = None

    def __post_init__(self) -> None:
        """Refuse a run without files of its own.

        Raises:
            ValueError: with one line naming the key, its value and what would be right.
        """
        if not self.csv:
            raise ValueError("logger.csv=False: it must be true, resuming and reports read the run folder's files")
