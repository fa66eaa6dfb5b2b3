"""Draw one episode: ``softgm-bench render SOURCE out=FILE[,FILE...] [key=value ...]``.

SOURCE is a run folder, a checkpoint or a policy's file, of which an episode is recorded, or a recorded episode (.npz).
The end of each FILE's name says what it is: .png a still, .mp4, .webp or .gif a video, .html an interactive page.

  seed=0 episode=0       which episode of a policy is recorded
  episodes=              of that evaluation: its size belongs to the seed; by default episode + 1
  horizon=  deterministic=true
  save=FILE.npz          keep the recorded episode
  step=                  moment of a still, in control steps; the last one by default
  fps=25 speed=          of a video; by default the slowest power of two at which it lasts at most 10 s
  width=960 height=720   pixels
  azimuth= elevation=    degrees: where the camera is, from +x towards +y and above the horizon
  distance=              m: how far away the camera is; by default so that the whole episode fits
  attention=false        draw attention as edges from discovered bins to agents, as opaque as it is strong
  text=                  write time and distance; by default in videos only
  threads=               by default all that there are; an evaluation's episode has the bits of its number of threads

Other settings change what the policy was trained with, e.g. task=wall_narrow or task.n_agents=8.
"""

import importlib.util
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from softgm_bench import command
from softgm_bench.errors import UserError
from softgm_bench.progress import Progress, tracked

if TYPE_CHECKING:
    from softgm_bench.episodes.trajectory import Trajectory

KINDS = (".png", ".mp4", ".webp", ".gif", ".html")
RANGES = {"width": (16, 4096), "height": (16, 4096), "fps": (1, 120), "elevation": (-89, 89), "azimuth": (-360, 360)}
RECORDING = ("seed", "episode", "episodes", "horizon", "deterministic")


@dataclass
class Options:
    """The command's settings; where one is None, the text above says what happens."""

    out: str = ""
    seed: int | None = None
    episode: int | None = None
    episodes: int | None = None
    horizon: int | None = None
    deterministic: bool | None = None
    save: str | None = None
    step: float | None = None
    fps: int = 25
    speed: float | None = None
    width: int = 960
    height: int = 720
    azimuth: float | None = None
    elevation: float | None = None
    distance: float | None = None
    attention: bool = False
    text: bool | None = None
    threads: int | None = None


def main(arguments: list[str]) -> None:
    """Record or load an episode and write every file.

    Raises:
        UserError: an argument that makes no sense, or a file that cannot be read or written.
    """
    source, options, overrides = command.parse(
        arguments, Options, "policy, checkpoint, run folder or recorded episode", others=True
    )
    files = [Path(name) for name in options.out.split(",") if name]
    _check(options, files)
    from softgm_bench.episodes import recording  # late: what is refused should not wait
    from softgm_bench.episodes import trajectory as episodes
    from softgm_bench.runs.machine import set_threads

    set_threads(options.threads)  # as an evaluation does: rounding depends on it
    chosen = {name: getattr(options, name) for name in RECORDING if getattr(options, name) is not None}
    if source.suffix == ".npz" and chosen:
        raise UserError(f"{min(chosen)}: {source} is recorded already; name a policy to record another episode")
    page = any(file.suffix == ".html" for file in files)
    with Progress("recording", None, "steps") as progress:
        seen = options.attention or page
        trajectory = recording.record_or_load(
            source, attention=seen, overrides=overrides, watch=progress.advance, **chosen
        )
    if options.step is not None and options.step > trajectory.steps:
        raise UserError(f"step is {options.step:g}: this episode has steps 0 to {trajectory.steps}")
    if options.attention and not trajectory.attention:
        raise UserError("attention: this episode has none; its policy has no attention, or it was recorded without")
    if options.save:
        episodes.save(trajectory, Path(options.save))
    for file in files:
        _write(trajectory, options, file)
        print(f"{episodes.describe(trajectory.info)}: {file}")


def _check(options: Options, files: list[Path]) -> None:
    wrong = [file for file in files if file.suffix not in KINDS]
    if len(files) > 1 and wrong:
        raise UserError(
            f"out={options.out}: commas stand between files, and {wrong[0]} ends in none of {', '.join(KINDS)}; "
            "a file's own name cannot hold one"
        )
    if wrong or not files:
        what = f"{wrong[0]}: its name must end in one of" if wrong else "out: name a file that ends in"
        raise UserError(f"{what} {', '.join(KINDS)}")
    kinds = {file.suffix for file in files}
    for name, (low, high) in RANGES.items():
        value = getattr(options, name)
        if value is not None and not low <= value <= high:
            raise UserError(f"{name} is {value}: it must be from {low} to {high}")
        if name in ("width", "height") and ".mp4" in kinds and value % 2:
            raise UserError(f"{name} is {value}: an MP4 video needs an even number")
    for name in ("speed", "distance", "threads"):
        value = getattr(options, name)
        if value is not None and not 0.0 < value < float("inf"):
            raise UserError(f"{name} is {value}: it must be above 0")
    if options.step is not None and not 0.0 <= options.step < float("inf"):
        raise UserError(f"step is {options.step:g}: it must be a control step from 0")
    if options.save is not None and Path(options.save).suffix != ".npz":
        raise UserError(f"{options.save}: a trajectory's file ends in .npz")
    for module, needing in {"PIL": kinds - {".html"}, "av": kinds & {".mp4"}}.items():
        if needing and importlib.util.find_spec(module) is None:
            raise UserError(f"{min(needing)}: {module} is not installed; pip install '.[render]'")


def _write(trajectory: "Trajectory", options: Options, file: Path) -> None:
    if file.suffix == ".html":
        from softgm_bench.render.html import write_html

        write_html(trajectory, file, azimuth=options.azimuth, elevation=options.elevation)
        return
    from softgm_bench.render import video
    from softgm_bench.render.still import PictureSettings, Studio, png
    from softgm_bench.storage.files import write_where_asked

    still = file.suffix == ".png"
    text = not still if options.text is None else options.text
    names = ("width", "height", "azimuth", "elevation", "distance", "attention")
    settings: dict[str, Any] = {name: getattr(options, name) for name in names}
    studio = Studio(trajectory, PictureSettings(text=text, **settings))
    if still:
        write_where_asked(file, png(studio.picture(float(trajectory.steps) if options.step is None else options.step)))
        return
    control_dt = studio.stage.control_dt
    speed = options.speed or video.natural_speed(trajectory.steps * control_dt)
    times = video.moments(trajectory.steps, control_dt, options.fps, speed)
    frames = tracked(video.pictures(studio, times, speed, options.threads), f"drawing {file}", len(times), "frames")
    mp4 = file.suffix == ".mp4"
    write_where_asked(
        file, video.mp4(frames, options.fps) if mp4 else video.animated(frames, options.fps, file.suffix[1:])
    )


if __name__ == "__main__":
    sys.exit(command.run("render", __doc__, main))
