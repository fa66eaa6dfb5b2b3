"""The table of the arm's tasks by name, filled by ``register_task``."""

from collections.abc import Callable
from typing import TypeVar

from softgm_bench.envs.tasks.base import Task, TaskConfig

TASKS: dict[str, type[Task]] = {}
TASK_CONFIGS: dict[str, type[TaskConfig]] = {}

TaskClass = TypeVar("TaskClass", bound=type[Task])


def register_task(*names: str) -> Callable[[TaskClass], TaskClass]:
    """Class decorator: each of ``names`` means this class, with ``config_class`` the schema of its YAML file.

    Raises:
        ValueError: if a name is registered already.
    """

    def register(task: TaskClass) -> TaskClass:
        for name in names:
            if name in TASKS:
                raise ValueError(f"task {name!r} is registered already")
            TASKS[name], TASK_CONFIGS[name] = task, task.config_class
        return task

    return register


def make_task(config: TaskConfig) -> Task:
    """Build the task that the configuration names."""
    return TASKS[config.name](config)
