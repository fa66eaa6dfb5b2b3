"""Tasks of the arm by name; the values of each are in ``conf/task/<name>.yaml``."""

from collections.abc import Callable
from typing import TypeVar

from softgm_bench.envs.tasks.base import Scene, Task, TaskConfig
from softgm_bench.envs.tasks.basic import Basic
from softgm_bench.envs.tasks.structured import Structured
from softgm_bench.envs.tasks.wall import Wall

TASKS: dict[str, type[Task]] = {}
TASK_CONFIGS: dict[str, type[TaskConfig]] = {}

TaskClass = TypeVar("TaskClass", bound=type[Task])


def register_task(*names: str) -> Callable[[TaskClass], TaskClass]:
    """Class decorator: each of ``names`` means this class, with ``config_class`` the schema of its YAML file."""

    def register(task: TaskClass) -> TaskClass:
        for name in names:
            if name in TASKS:
                raise ValueError(f"task {name!r} is registered already")
            TASKS[name], TASK_CONFIGS[name] = task, task.config_class
        return task

    return register


register_task("basic")(Basic)
register_task("structured")(Structured)
register_task("wall", "wall_narrow", "wall_fixed")(Wall)


def make_task(config: TaskConfig) -> Task:
    """Build the task that the configuration names."""
    return TASKS[config.name](config)


__all__ = ["TASKS", "TASK_CONFIGS", "Scene", "Task", "TaskConfig", "make_task", "register_task"]
