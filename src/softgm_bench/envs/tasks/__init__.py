"""Tasks of the arm, one file each; the values of each are in ``conf/task/<name>.yaml``."""

from importlib import import_module
from pkgutil import iter_modules

from softgm_bench.envs.tasks.base import Scene, Task, TaskConfig
from softgm_bench.envs.tasks.registry import TASK_CONFIGS, TASKS, make_task, register_task

for _module in iter_modules(__path__):  # each registers what it defines
    import_module(f"{__name__}.{_module.name}")

__all__ = ["TASKS", "TASK_CONFIGS", "Scene", "Task", "TaskConfig", "make_task", "register_task"]
