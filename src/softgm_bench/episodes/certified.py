"""Certified scenes: held-out scenes with a sequence of actions that is known to succeed in each.

A task may have a file of them, ``episodes/certified/<task>.npz``; ``softgm_bench.certify`` makes it. An evaluation
that plays scenes of the file counts its success on the certified ones by themselves: there, 1 is within reach.
"""

import io
import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from softgm_bench.assembly import build_env
from softgm_bench.config import Config
from softgm_bench.envs import SoftArmEnv, entries
from softgm_bench.episodes.evaluation import evaluation_seed
from softgm_bench.errors import UserError
from softgm_bench.storage.files import write_where_asked

FOLDER = Path(__file__).with_suffix("")
LEVELS = 127  # of an action's component on either side of 0: sequences are stored in one byte a number
# What decides, beside the arm, whether a sequence of actions succeeds in a scene.
DECISIVE = (
    "n_agents",
    "success_radius",
    "min_dilatation",
    "max_dilatation",
    "max_contact_steps",
    "contact_counts",
    "actuation",
)

Array = NDArray[Any]


@dataclass
class Certified:
    """The held-out scenes of a task, and what is known to succeed in them.

    Attributes:
        task: its name.
        seed: of the evaluation whose scenes they are.
        physics: what the sequences were played in, plain values; see ``physics``.
        target: m, ``(scenes, 3)`` float32.
        privileged: what the task tells of the scenes, ``(scenes, P)`` float32.
        length: control steps of each sequence, ``(scenes,)`` int64; 0: none is known.
        action: of all sequences one after the other, ``(steps, N, 2)`` int8, in units of 1 / ``LEVELS``.
        tried: sequences that were played in the search for each, ``(scenes,)`` int64.
    """

    task: str
    seed: int
    physics: dict[str, Any]
    target: Array
    privileged: Array
    length: Array
    action: Array
    tried: Array

    @property
    def scenes(self) -> int:
        """Their number."""
        return len(self.length)

    def actions(self, scene: int) -> torch.Tensor:
        """Give the sequence of a scene as the environment takes it, ``(length, N, 2)`` float32."""
        end = int(self.length[: scene + 1].sum())
        return dequantised(torch.from_numpy(self.action[end - int(self.length[scene]) : end]))


def quantised(action: torch.Tensor) -> torch.Tensor:
    """Round actions in [-1, 1] to int8 in units of 1 / ``LEVELS``."""
    return (action.clamp(-1.0, 1.0) * LEVELS).round().to(torch.int8)


def dequantised(action: torch.Tensor) -> torch.Tensor:
    """Give the float32 actions of what ``quantised`` returned."""
    return action.to(torch.float32) / LEVELS


def physics(env: SoftArmEnv) -> dict[str, Any]:
    """What decides whether actions succeed in a scene, as plain values."""
    task = asdict(env.task.config)
    values = {"task": {name: task[name] for name in DECISIVE}, "rod": asdict(env.backend.parameters)}
    return json.loads(json.dumps(values))


def scenes(config: Config, episodes: int, seed: int, batch: int | None = None) -> tuple[Array, Array]:
    """Draw the scenes that an evaluation plays: targets ``(episodes, 3)``, privileged ``(episodes, P)``, float32."""
    size, targets, told = batch or episodes, [], []
    for part, first in enumerate(range(0, episodes, size)):
        env = first_frame(config, min(size, episodes - first), evaluation_seed(seed, part))
        targets.append(env.scene.target.to(torch.float32).cpu().numpy())
        told.append(env.scene.privileged.to(torch.float32).cpu().numpy())
    return np.concatenate(targets), np.concatenate(told)


def first_frame(config: Config, episodes: int, seed: int) -> SoftArmEnv:
    """Build the environments that an evaluation would, at the beginning of its episodes."""
    env = build_env(config, episodes, seed)
    env.set_seed(seed)
    env.reset()
    return env


def save(certified: Certified, path: Path) -> None:
    """Write a file of scenes, compressed.

    Raises:
        UserError: it cannot be written.
    """
    about = {"task": certified.task, "seed": certified.seed, "physics": certified.physics}
    arrays = {name: getattr(certified, name) for name in ("target", "privileged", "action")}
    arrays |= {"length": certified.length.astype(np.int16), "tried": certified.tried.astype(np.int32)}
    buffer = io.BytesIO()
    np.savez_compressed(buffer, about=np.array(json.dumps(about)), **arrays)
    write_where_asked(path, buffer.getvalue())


def load(path: Path) -> Certified:
    """Read a file of scenes.

    Raises:
        UserError: there is none, or it is damaged.
    """
    try:
        with np.load(path) as file:
            about = json.loads(str(file["about"]))
            about["physics"]["task"].setdefault("contact_counts", "at_end")  # in files of before it could be chosen
            arrays = {name: file[name] for name in ("target", "privileged", "action", "length", "tried")}
    except (OSError, KeyError, ValueError) as error:
        raise UserError(f"{path}: no file of certified scenes; softgm_bench.certify makes them") from error
    arrays |= {name: arrays[name].astype(np.int64) for name in ("length", "tried")}
    return Certified(**about, **arrays)


@lru_cache
def of_task(name: str) -> Certified | None:
    """Give the certified scenes that come with this package; None where a task has none."""
    path = FOLDER / f"{name}.npz"
    return load(path) if path.exists() else None


def mask(config: Config, episodes: int, seed: int, batch: int | None, horizon: int | None) -> NDArray[np.bool_] | None:
    """Tell which episodes of an evaluation play a certified scene, ``(episodes,)``.

    None where that says nothing: the task has no file, its physics are others, or no scene of the evaluation is known.
    """
    known = of_task(config.task.name) if config.randomise.nothing else None
    if known is None or config.mixed or config.device != "cpu" or known.physics != physics(build_env(config, 1, 0)):
        return None
    limit = horizon or config.task.horizon
    solved = (known.length > 0) & (known.length <= limit)
    table = dict(zip(map(_key, known.target, known.privileged), solved.tolist(), strict=True))
    keys = list(map(_key, *scenes(config, episodes, seed, batch)))
    if not any(key in table for key in keys):
        return None
    return np.array([table.get(key, False) for key in keys])


def _key(target: Array, privileged: Array) -> bytes:
    return target.tobytes() + privileged.tobytes()


def replay(certified: Certified, config: Config, rows: Array, step: Callable[[Any], None] | None = None) -> Array:
    """Play the sequences of some scenes in the environment; whether each ended in success, ``(len(rows),)`` bool.

    All scenes are drawn, those of the other rows rest. ``step`` is called with each frame.

    Raises:
        ValueError: the task draws other scenes than those of the file.
    """
    env = first_frame(config, certified.scenes, evaluation_seed(certified.seed))
    if not np.array_equal(env.scene.target.to(torch.float32).numpy(), certified.target):
        raise ValueError(f"{certified.task}: the scenes of the file are not those that the task draws")
    wanted = np.isin(np.arange(certified.scenes), rows)
    env.simulator.state.episodes.truncated = torch.from_numpy(~wanted | (certified.length == 0))
    sequence = torch.zeros((certified.scenes, int(certified.length[rows].max(initial=0)), *certified.action.shape[1:]))
    for row in rows:
        actions = certified.actions(int(row))
        sequence[row, : len(actions)] = actions
    succeeded, td = torch.zeros(certified.scenes, dtype=torch.bool), env.fake_tensordict()
    for k in range(sequence.shape[1]):
        frame = env.step(td.set(entries.ACTION, sequence[:, k]))["next"]
        ended = torch.from_numpy(certified.length == k + 1)
        succeeded |= frame[entries.SUCCESS].squeeze(-1) & ended
        if step is not None:
            step(frame)
    return succeeded.numpy()[rows]
