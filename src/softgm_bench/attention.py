"""Draw where a policy looks: ``softgm-bench attention SOURCE [key=value ...]``.

SOURCE is a run folder, a checkpoint or a policy's file, of which an episode is recorded, or an episode that was
recorded with attention (.npz). The encoder must have attention in two stages, as SoftGM's has.

  seed=0 episode=0       which episode of an evaluation is recorded; a policy's alone, as the next four
  episodes=null          of that evaluation: its size belongs to the seed; null: episode + 1
  horizon=null           control steps of an episode; null: the task's own
  deterministic=true     false: actions are sampled
  threads=null           null: every core that this process may use
  steps=null             of the matrices, e.g. [0,25,60]; null: the first with the most edges to obstacles in each
                         quarter of the episode
  out=null               folder; null: SOURCE/attention/... of a run folder, outputs/attention/... of a file

Other settings change what the policy acts in, e.g. task=wall or perturbation=noise. Written are ``attention.npz`` (both
stages, every layer and head), ``overview.png`` and of every step ``step<step>.png`` and ``step<step>_heads.png``.
"""

import io
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from softgm_bench import command
from softgm_bench.config import available_threads
from softgm_bench.errors import UserError
from softgm_bench.progress import Progress, tracked

if TYPE_CHECKING:
    from softgm_bench.episodes.trajectory import Trajectory

RECORDING = ("seed", "episode", "episodes", "horizon", "deterministic", "threads")


@dataclass
class Options:
    """The command's settings; meanings above."""

    seed: int = 0
    episode: int = 0
    episodes: int | None = None
    horizon: int | None = None
    deterministic: bool = True
    threads: int | None = None
    steps: list[int] | None = None
    out: str | None = None


def main() -> int:
    """The exit status."""
    return command.run("attention", __doc__, _attention)


def _attention(arguments: list[str]) -> None:
    source, options, overrides = command.parse(
        arguments, Options, "run folder, checkpoint, policy's file or recorded episode", others=True
    )
    try:
        import matplotlib  # noqa: F401
    except ImportError as error:
        raise UserError("figures need matplotlib: pip install '.[report]'") from error
    if source.suffix == ".npz":
        given = [argument for argument in arguments if argument.partition("=")[0] in RECORDING]
        if given:
            raise UserError(f"{given[0]}: {source} is recorded already; name a policy to record another episode")
    trajectory = _episode(source, options, overrides)
    if not trajectory.attention:
        raise UserError(f"{source}: this episode has no attention; record one with attention, of model=softgm")
    folder = Path(options.out) if options.out is not None else _default_folder(source, trajectory, overrides)
    for name in _write(trajectory, options.steps, folder):
        print(folder / name)


def _episode(source: Path, options: Options, overrides: list[str]) -> "Trajectory":
    from softgm_bench.episodes.recording import record  # late: a refused command is quick
    from softgm_bench.episodes.trajectory import load

    if source.suffix == ".npz":
        if overrides:
            raise UserError(f"{overrides[0]}: {source} is recorded already, and takes no settings; name a policy")
        return load(source)
    if options.threads is not None and not 1 <= options.threads <= available_threads():
        raise UserError(f"threads={options.threads}: choose 1 to {available_threads()}, the cores here, or null")
    from softgm_bench.episodes import policy
    from softgm_bench.episodes.recording import attention_encoder
    from softgm_bench.runs.machine import set_threads

    trained = policy.load(source, overrides=overrides)
    if attention_encoder(trained.policy) is None:
        raise UserError(
            f"{source}: its model has no attention of two stages; name a policy that was trained with model=softgm"
        )
    set_threads(options.threads)  # as an evaluation does: rounding depends on it
    with Progress("recording", None, "steps") as progress:
        return record(
            trained,
            options.seed,
            options.episode,
            options.horizon,
            options.deterministic,
            attention=True,
            episodes=options.episodes,
            watch=progress.advance,
        )


def _default_folder(source: Path, trajectory: "Trajectory", overrides: list[str]) -> Path:
    import re

    info = trajectory.info
    name = re.sub(r"[^\w.-]+", "-", "_".join([info["task"], *overrides, f"seed{info['seed']}"]))
    name += f"_episode{info['episode']}of{info['episodes']}"
    if source.is_dir():
        return source / "attention" / name
    return Path("outputs") / "attention" / source.stem / name


def _write(trajectory: "Trajectory", steps: list[int] | None, folder: Path) -> list[str]:
    import numpy as np

    from softgm_bench.analysis import attention
    from softgm_bench.storage.files import write_atomically

    chosen = attention.busiest_steps(trajectory) if steps is None else steps
    for step in chosen:
        if not 0 <= step < trajectory.steps:
            raise UserError(f"steps={step}: the episode's steps are 0 to {trajectory.steps - 1}")
    content = io.BytesIO()
    np.savez_compressed(content, **attention.arrays(trajectory))  # type: ignore[arg-type]
    files = {"attention.npz": content.getvalue(), "overview.png": attention.png(attention.draw_overview(trajectory))}
    for step in tracked(chosen, "drawing", len(chosen), "steps"):
        for heads in (False, True):
            name = f"step{step:04d}{'_heads' if heads else ''}.png"
            files[name] = attention.png(attention.draw_step(trajectory, step, heads))
    folder.mkdir(parents=True, exist_ok=True)
    for name, data in files.items():
        write_atomically(folder / name, data)
    return list(files)


if __name__ == "__main__":
    sys.exit(main())
