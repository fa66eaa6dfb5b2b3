"""Writes a data set, chunk by chunk; what is there already is not collected again.

A chunk holds whole episodes of one policy. It is made of parts: episodes that are played side by side in environments
with a seed of their own. So a chunk does not depend on those before it, and an interrupted writing that goes on makes
the bytes of one that was never interrupted.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from tensordict import TensorDict

from softgm_bench.assembly import build_env
from softgm_bench.config import Config
from softgm_bench.datasets import chunks, layout
from softgm_bench.datasets.collecting import Collector, Tell
from softgm_bench.datasets.mixture import Behaviour, part_seed
from softgm_bench.episodes.evaluation import evaluate
from softgm_bench.errors import UserError
from softgm_bench.storage.files import to_json, write_atomically

FORMAT = 1
SETTINGS, SUMS, SHEET = "dataset.json", "SHA256SUMS", "datasheet.md"
TOLD = ("command",)  # settings that a repeated command may write otherwise
MADE_WITH = ("versions", "threads")  # and those that it may once the data set is finished


def begin(folder: Path, settings: Mapping[str, Any]) -> bool:
    """Note what is to be written; tells whether all of it is there already.

    Raises:
        UserError: the folder holds something else, or cannot be written.
    """
    wanted = json.loads(to_json(settings))
    file = folder / SETTINGS
    if file.exists():
        held, finished = read_settings(folder), (folder / SUMS).exists()
        left_out = TOLD + (MADE_WITH if finished else ())
        differs = next((key for key in wanted if key not in left_out and not _alike(key, held, wanted)), None)
        if differs is not None:
            raise UserError(f"out={folder} holds a data set with {_told(differs, held, wanted)}: choose another folder")
        chunks.sweep(folder)
        return finished
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise UserError(f"out={folder} exists and is no data set: choose another folder")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_atomically(file, (to_json(wanted, indent=2) + "\n").encode())
    except OSError as error:
        raise UserError(f"out={folder}: {error.strerror}; choose a folder that can be written") from error
    return False


def read_settings(folder: Path) -> dict[str, Any]:
    """Read what a folder's data set is.

    Raises:
        UserError: there is none, or it is of another version of this program.
    """
    try:
        settings = json.loads((folder / SETTINGS).read_bytes())
    except OSError as error:
        raise UserError(f"{folder}: no data set here, {SETTINGS}: {error.strerror}") from error
    except ValueError as error:
        raise UserError(f"{folder / SETTINGS}: damaged; remove the folder and write the data set again") from error
    if not isinstance(settings, dict) or settings.get("format") != FORMAT:
        raise UserError(f"{folder / SETTINGS}: a data set of another version of this program")
    return settings


def written(folder: Path) -> list[Path]:
    """Give the chunks that are there, in order, up to the first one that is missing."""
    files: list[Path] = []
    while (file := chunks.path(folder, len(files))).exists():
        files.append(file)
    return files


class Progressed:
    """How far a data set has come.

    Attributes:
        chunks: that are there.
        episodes: in them.
        transitions: of every policy.
        parts: of every policy that have been played.
    """

    def __init__(self, folder: Path, behaviours: int) -> None:
        """Look into the chunks that are there."""
        self.chunks, self.episodes = 0, 0
        self.transitions, self.parts = [0] * behaviours, [0] * behaviours
        for file in written(folder):
            self.add(chunks.read(file, layout.EPISODES))

    def add(self, episodes: TensorDict) -> None:
        """A chunk with these episodes is there."""
        policy = int(episodes["policy"][0])
        self.chunks += 1
        self.episodes += len(episodes)
        self.transitions[policy] += int(episodes["length"].sum())
        self.parts[policy] = int(episodes["part"].max()) + 1


def write(
    folder: Path,
    behaviours: Sequence[Behaviour],
    config: Config,
    settings: Mapping[str, Any],
    done: Progressed,
    tell: Tell,
) -> None:
    """Collect and write the chunks that are missing.

    Args:
        folder: of the data set, which ``begin`` has begun.
        behaviours: the policies.
        config: to act in.
        settings: as ``begin`` took them: ``seed``, ``batch``, ``horizon``, ``deterministic``, ``chunk``.
        done: how far the data set has come; it goes on with it.
        tell: follows.

    Raises:
        UserError: a chunk cannot be written; the message says how many are there.
        NotFinite: a policy has chosen an action that is not finite.
    """
    for number, behaviour in enumerate(behaviours):
        while done.transitions[number] < behaviour.transitions:
            content = _chunk(number, behaviour, config, settings, done, tell)
            try:
                chunks.write(content, chunks.path(folder, done.chunks))
            except OSError as error:
                whole = f"whole chunks so far: {done.chunks}, the same command goes on from there"
                raise UserError(f"out={folder}: {error.strerror}; {whole}") from error
            done.add(content[layout.EPISODES])


def finish(folder: Path, sheet: str) -> None:
    """Write the datasheet and, last, the checksums of everything: where they are, the data set is whole.

    Raises:
        UserError: they cannot be written.
    """
    try:
        write_atomically(folder / SHEET, sheet.encode())
        files = [folder / SETTINGS, folder / SHEET, *written(folder)]
        sums = "".join(f"{chunks.checksum(file)}  {file.name}\n" for file in files)
        write_atomically(folder / SUMS, sums.encode())
    except OSError as error:
        raise UserError(f"out={folder}: {error.strerror}; the same command finishes the data set") from error


def verify(folder: Path) -> None:
    """Compare a finished data set with its checksums.

    Raises:
        UserError: naming the first file that is missing or has changed.
    """
    try:
        lines = (folder / SUMS).read_text().splitlines()
    except OSError as error:
        raise UserError(f"{folder / SUMS}: {error.strerror}; the data set is not finished") from error
    for line in lines:
        told, _, name = line.partition("  ")
        if chunks.checksum(folder / name) != told:
            raise UserError(f"{folder / name}: it is not what {SUMS} says; it was changed or damaged")


def _chunk(
    number: int, behaviour: Behaviour, config: Config, settings: Mapping[str, Any], done: Progressed, tell: Tell
) -> TensorDict:
    """Play parts until they fill a chunk, or until the policy has its share."""
    parts: list[TensorDict] = []
    collected, episodes, part = done.transitions[number], done.episodes, done.parts[number]
    wanted = min(collected + settings["chunk"], behaviour.transitions)
    while collected < wanted:
        seed = part_seed(settings["seed"], number, part)
        env = build_env(config, settings["batch"], seed, settings["horizon"])
        collector = Collector(env, tell)
        deterministic = settings["deterministic"]
        records = evaluate(behaviour.policy, env, deterministic=deterministic, seed=seed, keep=collector.keep)
        about = {"policy": number, "part": part, "seed": seed}
        parts.append(collector.content(records, about, episodes, behaviour.transitions - collected))
        collected += int(parts[-1][layout.EPISODES, "length"].sum())
        episodes += len(parts[-1][layout.EPISODES])
        part += 1
    return layout.joined(parts)


def _alike(key: str, held: Mapping[str, Any], wanted: Mapping[str, Any]) -> bool:
    """Tell whether a setting is the same; of the configuration what is acted in, since fingerprints tell policies."""
    if key != "config":
        return held.get(key) == wanted[key]
    before = {"randomise": {"name": "none"}}  # data sets of before bodies could be drawn
    names = ("task", "rod", "perturbation", "randomise", "dtype")
    return all(_holds(held[key].get(name, before.get(name)), wanted[key][name]) for name in names)


def _holds(held: Any, wanted: Any) -> bool:
    """Compare settings, of which a later version may have more; those stand for what was always done."""
    if isinstance(held, Mapping) and isinstance(wanted, Mapping):
        return all(_holds(value, wanted.get(name)) for name, value in held.items())
    return held == wanted


def _told(key: str, held: Mapping[str, Any], wanted: Mapping[str, Any]) -> str:
    """Say in which setting two data sets differ, with its values where they are short."""
    values = [json.dumps(values.get(key)) for values in (held, wanted)]
    return f"{key}={values[0]} and not {values[1]}" if max(map(len, values)) <= 60 else f"another {key}"


def episodes_of(folder: Path) -> dict[str, np.ndarray]:
    """Give the columns of all episodes, with the number of the chunk that each is in."""
    columns: dict[str, list[np.ndarray]] = {}
    for number, file in enumerate(written(folder)):
        part = chunks.read(file, layout.EPISODES)
        for name, value in part.items():
            columns.setdefault(name, []).append(value.numpy().copy())
        columns.setdefault("chunk", []).append(np.full(len(part), number))
    return {name: np.concatenate(values) for name, values in columns.items()}
