"""Resume a run that was interrupted, if that is possible, from its newest checkpoint that is whole.

What a checkpoint holds is ``Run.state_dict``. On the same machine, with the same versions and number of threads, a run
that was interrupted and resumed writes the numbers of one that was not, bit by bit.
"""

import json
import sys
from pathlib import Path
from typing import Any, cast

from omegaconf import DictConfig, OmegaConf
from yaml import YAMLError

from softgm_bench.config import Config, plain, typed
from softgm_bench.config.comparison import ABSENT, as_written, differences
from softgm_bench.config.explain import USER_ERRORS
from softgm_bench.errors import UserError
from softgm_bench.models.finite import not_finite
from softgm_bench.runs import checkpoint
from softgm_bench.runs import folder as run_folder
from softgm_bench.runs.folder import ANEW
from softgm_bench.runs.run import Run
from softgm_bench.storage.run_folder import RunFolder
from softgm_bench.storage.versions import versions

TOTAL_FRAMES = "experiment.total_frames"


def finished(config: Config, frames: int) -> dict[str, Any] | None:
    """Summary of the run in ``run_dir`` if it has come to its end, which is then said; None otherwise.

    Args:
        config: of the run.
        frames: where its end is; a run that ended earlier was shorter and is to be resumed.

    Raises:
        UserError: the run has other settings, or cannot be read.
    """
    folder = RunFolder(Path(config.run_dir))
    if not folder.summary.exists():
        return None
    _refuse_other_settings(config, folder)
    try:
        summary = json.loads(folder.summary.read_text())
        if summary["frames"] < frames:
            return None
    except (ValueError, KeyError, TypeError) as error:
        raise UserError(f"{folder.summary}: damaged; {ANEW}") from error
    print(f"{folder.path}: finished already")
    return summary


def newest_state(config: Config) -> dict[str, Any] | None:
    """The newest whole checkpoint of the run in ``run_dir``; None, and a line that says so, if it has none yet.

    One that is damaged or not finite is passed over with a line.

    Raises:
        UserError: the run has other settings or cannot be read, or none of its checkpoints can be used.
    """
    folder = RunFolder(Path(config.run_dir))
    paths = folder.in_order()
    if paths or folder.config.exists():
        _refuse_other_settings(config, folder)
    for path in reversed(paths):
        try:
            state = checkpoint.load(path)
        except UserError as error:
            _say(f"passed over {error}")
            continue
        if (found := not_finite(state.get("policy", {}).items())) is not None:
            _say(f"passed over {path}: {found}, training had diverged")
            continue
        _say(f"{folder.path}: resuming after {state['frames']} frames")
        return state
    if paths:
        raise UserError(f"{folder.checkpoints}: no checkpoint here can be used; {ANEW}")
    _say(f"{folder.path}: no checkpoint to resume from, the run begins anew")
    return None


def restore(run: Run, state: dict[str, Any]) -> None:
    """Put a run that has just been built, and the files in its folder, where a checkpoint was written.

    Raises:
        UserError: another version wrote the checkpoint, or what was written down before it is missing.
    """
    try:
        run.load_state_dict(state)
        before = state["versions"]
    except (KeyError, AttributeError, TypeError, RuntimeError, ValueError) as error:
        raise UserError(f"{run.folder.path}: this version cannot resume from its checkpoint; {ANEW}") from error
    for name, version in versions().items():
        if before.get(name) != version:
            _say(f"{run.folder.path}: {name} was {before.get(name)} and is {version}: numbers may not repeat")
    run_folder.cut_back(run.folder, plain(run.config), run.iteration, run.evaluations)


def _refuse_other_settings(config: Config, folder: RunFolder) -> None:
    """Compare with ``config.yaml``, which is written before anything else.

    Raises:
        UserError: naming the first setting of another value, groups' names first.
    """
    try:
        held = typed(cast(DictConfig, OmegaConf.create(folder.config.read_text())))
    except (ValueError, TypeError, AttributeError, YAMLError, *USER_ERRORS) as error:
        raise UserError(f"{folder.config}: missing or of another version; {ANEW}") from error
    frames, held_frames = config.experiment.total_frames, held.experiment.total_frames
    if frames < held_frames:
        raise UserError(f"{TOTAL_FRAMES}={frames}: the run has {held_frames}; it can only grow")
    free = [TOTAL_FRAMES]
    if getattr(config.algo, "lr_schedule", "") == "constant":
        free.append("algo.lr_schedule_frames")  # follows total_frames, and nobody reads it
    for key, pair in differences(plain(config), plain(held), free).items():
        now, then = (None if value is ABSENT else value for value in pair)
        if now != then:
            raise UserError(
                f"{key}={as_written(now)}: the run in {folder.path} has {as_written(then)}; "
                "give that, or choose another run_dir"
            )


def _say(line: str) -> None:
    print(line, file=sys.stderr)
