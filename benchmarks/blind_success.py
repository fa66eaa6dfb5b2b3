"""How far an arm gets on a wall that feels nothing: the best blind success, by geometry alone.

``python benchmarks/blind_success.py`` prints three tables and writes the figures.

The ideal blind arm knows the task's distribution and the target, and moves where it wants. A try is a crossing of the
wall's plane at a point; it passes if the columns beside the opening, and the round ends of those that are cut, are at
least a clearance away on all sides. The best points are chosen one after the other, each to pass in as many as possible
of the openings that remain. For a plane that moves and turns, the points are places on the wall, so the arm is taken to
know the plane: a bound from above. At a dead end a try is lost.

The second table says how much of the opening the target tells: the coefficient of determination of its place along the
wall and of its height on held-out scenes, by a linear fit and by the mean of the nearest 50 of the scenes. ``wall``
redraws target and opening together until the way through is short enough; the others draw them independently.

The third says the same of the scenes of a curriculum, where one of two openings is closed: the share in which the side
that most of the nearest 50 scenes have is right. In the easiest of them targets lie straight behind the open one.
"""

import argparse
from pathlib import Path
from typing import Any

import torch
from record import write
from torch import Tensor

from softgm_bench.config import compose
from softgm_bench.envs.tasks import make_task
from softgm_bench.envs.tasks.wall import Wall

TASKS = ("wall", "wall_touch", "wall_search", "wall_decoy", "wall_sense")
TWO_OPENINGS = ("wall_decoy", "wall_sense")
DIFFICULTIES = (0.0, 0.5, 0.7, 0.8, 0.85, 0.9, 0.95, 1.0)
TRIES = (1, 2, 6)
CLEARANCE = 0.05  # m, the arm's radius
STEP = 0.01  # m, between two candidates
NEIGHBOURS = 50


def openings(task: Wall, count: int, seed: int) -> tuple[Tensor, Tensor]:
    """Draw scenes: place along the wall and height of the opening, m, ``(count, 2)``, and targets ``(count, 3)``."""
    scene = task.sample(count, torch.Generator().manual_seed(seed))
    told = scene.privileged
    along = told[:, 1] / told[:, 4].cos() if told.shape[1] > 4 else told[:, 1]
    return torch.stack([along, told[:, 2]], dim=-1), scene.target


def given(task: Wall, target: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Draw openings of ``wall`` that go with one target, ``(n, 2)``: those of ``count`` that it could be drawn with."""
    c = task.config
    low, high = torch.tensor([c.opening_y, c.opening_z], dtype=torch.float64).T
    drawn = low + (high - low) * torch.rand((count, 2), generator=generator, dtype=torch.float64)
    centre = torch.cat([torch.full((count, 1), c.wall_x, dtype=torch.float64), drawn], dim=-1)
    way = centre.norm(dim=-1) + (target - centre).norm(dim=-1)
    return drawn[way <= c.max_path]


def room(task: Wall, opening: Tensor) -> tuple[Tensor, Tensor]:
    """Give where an arm may cross, along the wall and in height: the lowest and highest, ``(n, 2)`` each, m."""
    c = task.config
    along, half = torch.tensor(task.column_y, dtype=torch.float64), 0.5 * c.opening_side
    offset = along - opening[:, :1]
    cut, keep = offset.abs() <= half + 1e-12, c.column_radius + CLEARANCE
    left = (along + keep).expand_as(offset).masked_fill(cut | (offset > 0.0), -torch.inf).amax(dim=1)
    right = (along - keep).expand_as(offset).masked_fill(cut | (offset < 0.0), torch.inf).amin(dim=1)
    low, high = opening[:, 1] - half + keep, opening[:, 1] + half - keep
    return torch.stack([left, low], dim=-1), torch.stack([right, high], dim=-1)


def coverage(task: Wall, opening: Tensor, tries: int) -> list[float]:
    """Share of openings ``(n, 2)`` that the best 1, 2, .., ``tries`` points pass through, chosen greedily."""
    low, high = opening.amin(dim=0), opening.amax(dim=0)
    axes = [torch.arange(float(a), float(b) + STEP, STEP, dtype=torch.float64) for a, b in zip(low, high, strict=True)]
    points = torch.cartesian_prod(*axes)
    first, last = room(task, opening)
    passes = ((points[:, None] >= first - 1e-9) & (points[:, None] <= last + 1e-9)).all(dim=-1)
    remaining, shares = torch.ones(len(opening), dtype=torch.bool), []
    for _ in range(tries):
        best = (passes & remaining).sum(dim=1).argmax()
        remaining &= ~passes[best]
        shares.append(1.0 - remaining.double().mean().item())
    return shares


def blind(name: str, targets: int, count: int) -> dict[str, Any]:
    task = make_task(compose([f"task={name}", "recipe=paper"]).task)
    if type(task) is not Wall:  # whatever the target, the openings are the same
        shares = [coverage(task, openings(task, count, 0)[0], max(TRIES))]
    else:
        generator = torch.Generator().manual_seed(0)
        shown = openings(task, targets, 1)[1]
        shares = [coverage(task, given(task, target, 4 * count, generator)[:count], max(TRIES)) for target in shown]
    mean = torch.tensor(shares).mean(dim=0)
    return {"task": name} | {f"tries_{tries}": round(float(mean[tries - 1]), 3) for tries in TRIES}


def nearest(target: Tensor) -> Tensor:
    """For each scene of the second half those of the first half with the nearest targets, ``(n, NEIGHBOURS)``."""
    n = len(target) // 2
    scaled = (target - target[:n].mean(dim=0)) / target[:n].std(dim=0)
    return torch.cdist(scaled[n:], scaled[:n]).topk(NEIGHBOURS, dim=1, largest=False).indices


def explained(opening: Tensor, target: Tensor) -> dict[str, float]:
    """Coefficients of determination on the second half of the scenes, fitted to the first half."""
    n = len(opening) // 2
    design = torch.cat([torch.ones(len(target), 1, dtype=target.dtype), target], dim=-1)
    linear = design[n:] @ torch.linalg.lstsq(design[:n], opening[:n]).solution
    found = {}
    for kind, guess in (("linear", linear), ("nearest", opening[:n][nearest(target)].mean(dim=1))):
        rest = (opening[n:] - guess).square().mean(dim=0) / opening[n:].var(dim=0)
        found |= {f"{kind}_{axis}": round(1.0 - float(rest[i]), 3) for i, axis in enumerate(("along", "height"))}
    return found


def told(name: str, count: int) -> dict[str, Any]:
    task = make_task(compose([f"task={name}", "recipe=paper"]).task)
    return {"task": name} | explained(*openings(task, count, 0))


def side_told(left: Tensor, target: Tensor) -> float:
    """Share of the second half of the scenes whose open side is that of most of the nearest in the first half."""
    n = len(left) // 2
    guess = left[:n][nearest(target)].double().mean(dim=1) > 0.5
    return float((guess == left[n:]).double().mean())


def by_difficulty(name: str, count: int) -> dict[str, Any]:
    task = make_task(compose([f"task={name}", "recipe=tuned"]).task)  # the recipe that has a curriculum
    row: dict[str, Any] = {"task": name}
    for difficulty in DIFFICULTIES:
        scene = task.sample(count, torch.Generator().manual_seed(0), torch.tensor(difficulty, dtype=torch.float64))
        row[f"{difficulty:g}"] = round(side_told(scene.privileged[:, 1] > 0.0, scene.target), 3)
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--targets", type=int, default=100, help="of wall, over which is averaged")
    parser.add_argument("--openings", type=int, default=1500, help="drawn for each target")
    parser.add_argument("--scenes", type=int, default=8000, help="for what the target tells")
    parser.add_argument("--output", type=Path, default=Path(__file__).parent / "results/blind_success.json")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    rows = [blind(name, arguments.targets, arguments.openings) for name in TASKS]
    explains = [told(name, arguments.scenes) for name in TASKS]
    sides = [by_difficulty(name, arguments.scenes) for name in TWO_OPENINGS]
    for table in (rows, explains, sides):
        print(" | ".join(table[0]))
        print("\n".join(" | ".join(str(value) for value in row.values()) for row in table))
    settings = {name: getattr(arguments, name) for name in ("targets", "openings", "scenes")}
    write(arguments.output, {"clearance": CLEARANCE} | settings | {"blind": rows, "told": explains, "sides": sides})


if __name__ == "__main__":
    main()
