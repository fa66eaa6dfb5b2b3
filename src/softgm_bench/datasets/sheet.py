"""The datasheet of a data set: the questions of Gebru et al. (2021), answered from what was run."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softgm_bench.datasets import chunks, layout, writing
from softgm_bench.datasets.mixture import OF_TRAINING
from softgm_bench.envs import Sizes, entries
from softgm_bench.episodes.evaluation import EpisodeRecords
from softgm_bench.episodes.summary import summarise

NOT_TOLD = "Not told."
HEADER = "| policy | source | trained on frames | share asked for | episodes | transitions | success [95 %] | return |"


def fill(folder: Path, settings: Mapping[str, Any], sizes: Sizes) -> str:
    """Answer the questions about the data set in a folder, in Markdown."""
    episodes = writing.episodes_of(folder)
    stored = sum(file.stat().st_size for file in writing.written(folder))
    transitions = int(episodes["length"].sum())
    facts = {
        "name": settings["name"],
        "task": settings["task"],
        "purpose": settings["purpose"] or NOT_TOLD,
        "author": settings["author"] or NOT_TOLD,
        "licence": settings["licence"],
        "episodes": len(episodes["length"]),
        "transitions": transitions,
        "agents": sizes.n_agents,
        "policies": table(settings, episodes),
        "bytes": f"{stored / transitions:.0f}",
        "megabytes": f"{stored / 1e6:.2f}",
        "chunks": len(writing.written(folder)),
        "plain": plain_bytes(folder, sizes),
        "settings": settings_table(settings),
        "versions": ", ".join(f"{name} {version}" for name, version in settings["versions"].items()),
        "acting": "the mode of each policy" if settings["deterministic"] else "samples of each policy, as in training",
        "ends": ends(episodes),
        "seed": settings["seed"],
        "batch": settings["batch"],
        "threads": settings["threads"],
        "command": settings["command"],
        "entries": entries_table(folder),
    }
    return TEMPLATE.format(**facts)


def table(settings: Mapping[str, Any], episodes: Mapping[str, NDArray[Any]]) -> str:
    """What each policy is and how its episodes went, as Markdown."""
    rows = [HEADER, "|" + " --- |" * (HEADER.count(" |"))]
    for number, about in enumerate(settings["policies"]):
        own = {name: values[episodes["policy"] == number] for name, values in episodes.items()}
        metrics = summarise(EpisodeRecords(own, settings["horizon"]))
        success = metrics.get("success_rate")
        told = "" if success is None else f"{success['mean']:.3f} [{success['low']:.3f}, {success['high']:.3f}]"
        cells = [
            f"{number}: {about['label']}",
            f"`{about['source']}`" + (f", parameters {about['fingerprint']}" if about["fingerprint"] else ""),
            f"{about['frames']:,}",
            f"{about['share']:.3f}",
            len(own["length"]),
            int(own["length"].sum()),
            told,
            f"{metrics['undiscounted_return']['mean']:.2f} +- {metrics['undiscounted_return']['std']:.2f}",
        ]
        rows.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(rows)


def plain_bytes(folder: Path, sizes: Sizes) -> int:
    """Bytes of a transition whose two observations are written out whole, as TorchRL's own data sets have them."""
    frames = chunks.read(writing.written(folder)[0], layout.FRAMES)[:1]
    shown = layout.unpack(frames, _descriptors(folder), sizes)
    steps = frames["next"].values(include_nested=True, leaves_only=True)
    observation = sum(value.nbytes for key, value in shown.items() if key not in (*_OWN, entries.ACTION))
    own = sum(shown[key].nbytes for key in (layout.EPISODE, layout.POLICY, entries.ACTION))
    return 2 * observation + own + sum(value.nbytes for value in steps)


def settings_table(settings: Mapping[str, Any]) -> str:
    """Everything that decides what an episode is, as Markdown."""
    rows = ["| setting | value |", "| --- | --- |"]
    for key in ("task", "rod", "perturbation", "randomise", "dtype"):
        if key not in settings["config"]:
            continue  # a data set of before bodies could be drawn
        rows += [f"| `{name}` | {value} |" for name, value in _single(key, settings["config"][key])]
    rows += [f"| `{key}` | {settings[key]} |" for key in ("backend", "device", "horizon")]
    return "\n".join(rows)


def ends(episodes: Mapping[str, NDArray[Any]]) -> str:
    """How episodes ended, in words."""
    counts = [f"{int(episodes[name].sum())} {name}" for name in _ENDINGS if name in episodes]
    length = np.asarray(episodes["length"])
    return f"{', '.join(counts)}; length {length.min()} to {length.max()}, {length.mean():.1f} on average"


def entries_table(folder: Path) -> str:
    """The entries of a chunk with their shapes and types, as Markdown."""
    file = writing.written(folder)[0]
    rows = ["| part | entry | shape | type | bytes a row |", "| --- | --- | --- | --- | --- |"]
    for part in (layout.FRAMES, layout.TABLE, layout.EPISODES):
        if not chunks.has(file, part):
            continue
        for key, value in chunks.read(file, part).items(include_nested=True, leaves_only=True):
            name = key if isinstance(key, str) else "/".join(key)
            shape = ", ".join(["rows", *map(str, value.shape[1:])])
            size = value.element_size() * value.shape[1:].numel()
            rows.append(f"| `{part}` | `{name}` | ({shape}) | {str(value.dtype).removeprefix('torch.')} | {size} |")
    return "\n".join(rows)


def _single(key: str, value: Any) -> list[tuple[str, Any]]:
    """Give single settings by dotted key, without those of training alone."""
    if not isinstance(value, Mapping):
        return [(key, value)]
    inner = [(name, value[name]) for name in sorted(value) if name not in OF_TRAINING]
    return [pair for name, held in inner for pair in _single(f"{key}.{name}", held)]


_OWN = (layout.EPISODE, layout.POLICY, layout.FINAL)
_ENDINGS = ("success", "diverged", "contact_failure")


def _descriptors(folder: Path) -> Any:
    file = writing.written(folder)[0]
    return chunks.read(file, layout.TABLE)["descriptor"] if chunks.has(file, layout.TABLE) else None


TEMPLATE = """\
# Datasheet: {name}

The questions of Gebru et al., "Datasheets for Datasets" (2021), answered by the command that wrote the data set, from
what it ran.

## Motivation

**For what purpose?** {purpose}

**Created by whom?** {author}

## Composition

**What is in it?** {transitions} transitions of {episodes} whole episodes, simulated, on the task `{task}`, whose
{agents} agents act together for one reward. Nothing in it is about people.

{policies}

Policies are numbered as in the entry `policy`; success and return are those of the episodes in the data set. Of each
policy as many whole episodes were kept, in the order of their numbers, as make up its share of transitions; so its last
episode is a little more likely to be a long one.

**How did episodes end?** {ends}. The others lasted until the horizon.

**How is it stored?** In {chunks} files, {megabytes} MB: {bytes} bytes a transition. Whole transitions with both
observations written out would take {plain}. Every frame is stored once; the entries:

{entries}

**Is anything missing?** What a policy that remembers had in mind, the probabilities of the actions, and the state of
the simulation beyond what agents observe. Actions and seeds are there, from which the simulation makes them again.

**Are there errors?** Observations, actions and rewards are what the environment gave, bit by bit, float32. A
perturbation, if there is one in the settings below, is part of what agents observed.

**Recommended splits?** None; an episode belongs to one split, or observations of one scene are in both.

## Collection process

**How was it collected?** By playing the policies in the simulator, {batch} episodes side by side; actions were
{acting}.

```
{command}
```

**With which seeds?** Seed {seed}, from which every {batch} episodes have a seed of their own, told with every episode;
no training and no evaluation of this package uses these. The command above makes the same bytes again with as many
threads ({threads}), the same versions and the same kind of processor.

{settings}

Versions: {versions}.

## Preprocessing

None, beside the layout: flags of slots are packed to bits, and descriptors of obstacles are stored once an episode.
Both are undone without loss.

## Uses

Offline reinforcement learning, behaviour cloning, models of the arm's dynamics, tests of replay buffers. **For what
not?** It says nothing about a real arm beyond what the simulator does. Success of what is learnt here is measured by
`softgm-bench evaluate` and not on these transitions.

## Distribution and maintenance

**Licence:** {licence}. **Integrity:** `sha256sum -c SHA256SUMS` in this folder. **Corrections:** another data set under
another name; files that carry these checksums do not change.
"""
