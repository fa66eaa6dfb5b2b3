"""Reference benchmark for distributed control of soft robotic arms.

What most users need is here and loaded when it is first asked for, because torch takes seconds; the rest of the Python
interface is ``softgm_bench.api``. Asking for any of it prepares the process (``softgm_bench.process``), importing the
package does not.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from softgm_bench.api import evaluate, load, make_env, train
    from softgm_bench.envs import SoftArmEnv

__version__ = "0.1.0"
__all__ = ["SoftArmEnv", "__version__", "evaluate", "load", "make_env", "train"]

_HOMES = {"SoftArmEnv": "envs"} | dict.fromkeys(("api", "evaluate", "load", "make_env", "train"), "api")


def __getattr__(name: str) -> Any:
    """Prepare the process and load what is listed in ``__all__``, or ``api``, from its home."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    import_module(f"{__name__}.process").prepare()
    home = import_module(f"{__name__}.{_HOMES[name]}")
    return home if name == _HOMES[name] else getattr(home, name)


def __dir__() -> list[str]:
    """List what can be asked for."""
    return sorted({*globals(), *__all__})
