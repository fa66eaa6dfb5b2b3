"""Tasks by name; the values of each are in ``conf/task/<name>.yaml``."""

from softgm_bench.envs.tasks.base import Scene, Task, TaskConfig
from softgm_bench.envs.tasks.basic import Basic
from softgm_bench.envs.tasks.structured import Structured
from softgm_bench.envs.tasks.wall import Wall

TASKS: dict[str, type[Task]] = {
    "basic": Basic,
    "structured": Structured,
    "wall": Wall,
    "wall_narrow": Wall,
    "wall_fixed": Wall,
}
TASK_CONFIGS: dict[str, type[TaskConfig]] = {name: task.config_class for name, task in TASKS.items()}


def make_task(config: TaskConfig) -> Task:
    """Build the task that the configuration names."""
    return TASKS[config.name](config)


__all__ = ["TASKS", "TASK_CONFIGS", "Scene", "Task", "TaskConfig", "make_task"]
