"""Tasks, models and algorithms of your own: folders that the environment variable ``SOFTGM_BENCH_PLUGINS`` names.

Such a folder holds ``*.py``, which register what they define, and ``conf/<group>/<name>.yaml`` with the values. A
variable and not a setting: sweeps hand it on to their workers, every command reads it, and a checkpoint from somewhere
else can name no code that would then be run.
"""

import importlib
import os
import sys
from pathlib import Path

from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.plugins import Plugins
from hydra.plugins.search_path_plugin import SearchPathPlugin

from softgm_bench.errors import UserError

VARIABLE = "SOFTGM_BENCH_PLUGINS"


_imported: dict[Path, UserError | None] = {}


class PluginSearchPath(SearchPathPlugin):
    """Lets Hydra look into the folders' ``conf``, after ours: what we have cannot be replaced."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        """Append every folder's."""
        for folder in folders():
            if (folder / "conf").is_dir():
                search_path.append("softgm_bench.plugins", (folder / "conf").as_uri())


Plugins.instance().register(PluginSearchPath)


def folders() -> list[Path]:
    """The folders, in order.

    Raises:
        UserError: there is no such folder.
    """
    named = [Path(name).resolve() for name in os.environ.get(VARIABLE, "").split(os.pathsep) if name]
    for folder in named:
        if not folder.is_dir():
            raise UserError(f"{VARIABLE}: {folder} is no folder")
    return named


def add(folder: Path | str) -> None:
    """Use one more folder in this process and those that it starts.

    Raises:
        UserError: the folder or a file in it cannot be used.
    """
    known = os.environ.get(VARIABLE)
    os.environ[VARIABLE] = os.pathsep.join([*([known] if known else []), str(Path(folder).resolve())])
    load()


def load() -> None:
    """Import what has not been imported yet; names that begin with an underscore are for the other files.

    Raises:
        UserError: a file that cannot be imported.
    """
    for folder in folders():
        for file in sorted(folder.glob("[!_]*.py")):
            if file not in _imported:
                _imported[file] = _import(file)
            if (error := _imported[file]) is not None:
                raise error


def _import(file: Path) -> UserError | None:
    if str(file.parent) not in sys.path:
        sys.path.append(str(file.parent))
    try:
        module = importlib.import_module(file.stem)
    except Exception as error:
        lines = str(error).strip().splitlines()
        failure = UserError(f"{file}: {type(error).__name__}{f': {lines[0]}' if lines else ''}")
        failure.__cause__ = error
        return failure
    found = getattr(module, "__file__", None)
    if found is None or Path(found).resolve() != file:
        return UserError(f"{file}: another module is called {file.stem}; choose another name for the file")
    return None
