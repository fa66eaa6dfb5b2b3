"""Written during training: ``metrics.csv``, one row an iteration, and the statistics of its episodes."""

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Self

import torch
from tensordict import TensorDict, TensorDictBase

from softgm_bench.envs import entries
from softgm_bench.episodes.summary import BY_NUMBER

Row = Mapping[str, float | int]


class CsvWriter:
    """Appends rows to a CSV file, each written out before the next begins. The first row names the columns.

    A file that is appended to keeps its columns: what an earlier version did not measure is left out.
    """

    def __init__(self, path: Path, append: bool = False) -> None:
        """Create the file, or empty it; with ``append``, append to the rows that it holds."""
        self._file = path.open("a+" if append else "w", newline="")
        self._writer: csv.DictWriter | None = None
        self._append = append
        if append:
            self._file.seek(0)  # writing is at the end, wherever reading is
            names = next(csv.reader(self._file), None)
            self._writer = None if names is None else csv.DictWriter(self._file, names, lineterminator="\n")

    def write(self, row: Row) -> None:
        """Append a row.

        Raises:
            ValueError: it lacks a column of the first, or has one that the first has not.
        """
        if self._writer is None:
            self._writer = csv.DictWriter(self._file, list(row), lineterminator="\n")
            self._writer.writeheader()
        columns = set(self._writer.fieldnames)
        if self._append:
            row = {name: value for name, value in row.items() if name in columns}
        if row.keys() != columns:
            raise ValueError(f"columns changed: {sorted(row.keys() ^ columns)}")
        self._writer.writerow(row)
        self._file.flush()

    def __enter__(self) -> Self:
        """The writer itself."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        """Close the file."""
        self._file.close()


class EpisodeTracker:
    """Return and length of the episodes under way, one per environment, across batches of steps."""

    def __init__(self, num_envs: int, device: str) -> None:
        """Every environment is at the start of an episode."""
        self._return = torch.zeros(num_envs, dtype=torch.float64, device=device)
        self._length = torch.zeros(num_envs, dtype=torch.int64, device=device)

    def update(self, batch: TensorDictBase) -> dict[str, float | int]:
        """Statistics of the episodes that end within ``batch``, whose shape is ``(num_envs, steps)``.

        Without any such episode the means are NaN. A task without a notion of success has none of that kind.
        """
        after = batch["next"]
        reward, done = after[entries.REWARD].squeeze(-1), after[entries.DONE].squeeze(-1)
        returns, lengths = [], []
        for step in range(batch.shape[1]):
            self._return += reward[:, step]
            self._length += 1
            returns.append(self._return.clone())
            lengths.append(self._length.clone())
            self._return[done[:, step]] = 0.0
            self._length[done[:, step]] = 0
        row: dict[str, float | int] = {
            "episodes": int(done.sum()),
            "episode_return": torch.stack(returns, 1)[done].mean().item(),
            "episode_length": torch.stack(lengths, 1)[done].double().mean().item(),
        }
        if entries.SUCCESS in after.keys(include_nested=True):
            success, diverged = (after[key].squeeze(-1)[done] for key in (entries.SUCCESS, entries.DIVERGED))
            row |= {"success_rate": success.double().mean().item(), "diverged": int(diverged.sum())}
        return row

    def state_dict(self) -> dict[str, torch.Tensor]:
        """Give what the episodes under way have gathered."""
        return {"return": self._return, "length": self._length}

    def load_state_dict(self, state: Mapping[str, torch.Tensor]) -> None:
        """Resume from what ``state_dict`` returned for as many environments."""
        self._return.copy_(state["return"])
        self._length.copy_(state["length"])


def of_team(batches: Sequence[TensorDictBase]) -> TensorDictBase:
    """What the environments of several batches did, one after the other, but for what has a dimension of agents.

    Of one batch that batch.
    """
    if len(batches) == 1:
        return batches[0]
    keys = [key for key, entry in entries.TABLE.items() if entry.shape == (1,)]
    told = [TensorDict({"next": batch["next"].select(*keys, strict=False)}, batch.batch_size) for batch in batches]
    return TensorDict.cat(told)


def success_by_number(batches: Sequence[TensorDictBase], numbers: Sequence[int]) -> dict[str, float]:
    """Success rate of the episodes that end in each number's batch; NaN where none ends. Nothing without numbers."""
    rates = {}
    for number, batch in zip(numbers, batches, strict=bool(numbers)):
        after = batch["next"]
        rates[f"{BY_NUMBER}{number}"] = after[entries.SUCCESS][after[entries.DONE]].double().mean().item()
    return rates


def step_metrics(batch: TensorDictBase) -> dict[str, float]:
    """Reduce a batch ``(num_envs, steps)`` to numbers, as the table of entries asks; without any, to the reward."""
    after = batch["next"]
    told = after.keys(include_nested=True)
    columns = [column for column in entries.ITERATION_COLUMNS if column.key in told]
    if not columns:
        return {"reward": after[entries.REWARD].double().mean().item()}
    return {
        column.name: (
            after[column.key].max() if column.reduction == entries.MAX else after[column.key].double().mean()
        ).item()
        for column in columns
    }
