"""Simulate a recorded episode again: ``softgm-bench replay TRAJECTORY.npz key=value ...``

The recorded actions, and forces if any, act on the arm among the recorded cylinders; no policy is asked.

    backend=numba       numba: the recording's bits; torch: the reference; pyelastica: PyElastica itself, in float64
    pruning=false       PyElastica's bounding boxes, which may miss contacts, as it is shipped; otherwise off
    out=null            file of the differences at every step, JSON
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from softgm_bench import command
from softgm_bench.errors import UserError
from softgm_bench.progress import Progress

if TYPE_CHECKING:
    from softgm_bench.episodes.replay import Replay
    from softgm_bench.episodes.trajectory import Trajectory

ROWS = 10  # of the table of differences over time


@dataclass
class Options:
    """The command's settings; the module's text says what they mean."""

    backend: str = "numba"
    pruning: bool = False
    out: str | None = None


def main() -> int:
    """The exit status."""
    return command.run("replay", __doc__, _replay)


def _replay(arguments: list[str]) -> None:
    path, options, _ = command.parse(arguments, Options, "trajectory")
    from softgm_bench.episodes import trajectory

    if path.suffix != ".npz":
        raise UserError(f"{path}: name a recorded episode, a file that ends in .npz")
    recorded = trajectory.load(path)
    from softgm_bench.episodes import replay  # late: a refused file need not wait for torch

    with Progress("replaying", recorded.steps, "steps") as progress:
        replayed = replay.replay(recorded, options.backend, options.pruning, progress.advance)
    result = replay.compare(recorded, replayed)
    print("\n".join(report(recorded, replayed, result, options)))
    if options.out is not None:
        _write(Path(options.out), recorded, replayed, result, options)


def report(recorded: "Trajectory", replayed: "Replay", result: dict[str, Any], options: Options) -> list[str]:
    """The comparison in lines for a reader."""
    from softgm_bench.episodes.trajectory import describe

    seconds = recorded.rod.control_dt
    lines = [
        f"{describe(recorded.info)}: {recorded.steps} steps, {recorded.steps * seconds:.2f} s",
        f"recorded by {recorded.info['backend']} in {recorded.position.dtype}, replayed by {options.backend} in "
        f"{replayed.position.dtype}: " + ("equal in every bit" if result["identical"] else "not equal in every bit"),
    ]
    if replayed.missed is not None:
        boxes = "on: they skipped" if options.pruning else "off: they would have skipped"
        lines.append(f"PyElastica's bounding boxes {boxes} {replayed.missed} contacts (cylinder and substep)")
    if not result["identical"]:
        lines += ["largest difference until", f"{'s':>8}{'position, m':>14}"]
        until = [max(result["position"][: step + 1]) for step in range(recorded.steps + 1)]
        shown = sorted({round(recorded.steps * row / ROWS) for row in range(1, ROWS + 1)} - {0})
        lines += [f"{step * seconds:>8.2f}{until[step]:>14.1e}" for step in shown]
        largest = result["largest"]
        lines.append(
            f"of a director's component {largest['director']:.1e}, "
            f"of a velocity {largest['velocity']:.1e} m/s, of an angular velocity {largest['omega']:.1e} rad/s"
        )
    for side in ("recorded", "replayed"):
        outcome = result[side]
        reached = "not reached" if outcome["reached"] is None else f"reached after step {outcome['reached']}"
        lines.append(f"{side}: tip {outcome['final_distance']:.6f} m from the target at the end, {reached}")
    return lines


def _write(path: Path, recorded: "Trajectory", replayed: "Replay", result: dict[str, Any], options: Options) -> None:
    from softgm_bench.storage.files import to_json, write_atomically

    forces = None if replayed.contact_force is None else replayed.contact_force.tolist()
    about = {"info": recorded.info, "backend": options.backend, "pruning": options.pruning}
    contacts = {"missed": replayed.missed, "contact_force": forces}
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, (to_json(about | result | contacts) + "\n").encode())


if __name__ == "__main__":
    sys.exit(main())
