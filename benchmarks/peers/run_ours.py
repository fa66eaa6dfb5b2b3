"""One training run with softgm_bench, in its own virtual environment: ``pip install -e '.[vmas]'``."""

import csv
import json
import sys
import tempfile
from pathlib import Path

import yaml
from cells import HERE, Cell, asked_for, write

from softgm_bench.config import compose
from softgm_bench.runs.loop import train


def overrides(cell: Cell, run_dir: str, threads: int) -> list[str]:
    """What ``settings.yaml`` says, as ``python -m softgm_bench`` takes it."""
    settings = yaml.safe_load((HERE / "settings.yaml").read_text())
    shared, own = settings["shared"], settings[cell.group]
    task = {f"task.scenario.{name}": value for name, value in settings["tasks"][cell.task].items()}
    return [
        f"task=vmas_{cell.task}",
        f"algo={cell.algo}",
        "model=vector_mlp",
        "recipe=paper",
        f"seed={cell.seed}",
        f"threads={threads}",
        f"run_dir={run_dir}",
        *(f"{key}={_text(value)}" for key, value in (task | _experiment(settings, shared, own)).items()),
        *(f"algo.{key}={_text(value)}" for key, value in _algorithm(cell, shared, own).items()),
    ]


def _experiment(settings: dict, shared: dict, own: dict) -> dict:
    never = 10**9
    return {
        "task.horizon": settings["horizon"],
        "task.limit_terminates": True,
        "experiment.train_horizon": None,
        "experiment.total_frames": own["total_frames"],
        "experiment.num_envs": shared["num_envs"],
        "experiment.steps_per_batch": own["steps_per_batch"],
        "experiment.evaluation.interval": own["evaluation_interval"],
        "experiment.evaluation.episodes": shared["evaluation_episodes"],
        "experiment.evaluation.final_episodes": 1,
        "experiment.evaluation.deterministic": True,
        "experiment.checkpoint.interval": never,
    }


def _algorithm(cell: Cell, shared: dict, own: dict) -> dict:
    common = {
        "gamma": shared["gamma"],
        "max_grad_norm": shared["max_grad_norm"],
        "actor_lr": own["lr"],
        "critic_lr": own["lr"],
        "actor.widths": shared["widths"],
        "critic.widths": shared["widths"],
    }
    gaussian = {f"actor.{name}": value for name, value in shared["gaussian"].items()}
    if cell.group == "on_policy":
        same = ("epochs", "minibatch_size", "clip_epsilon", "gae_lambda", "entropy_coeff", "critic_coeff")
        return common | gaussian | {name: own[name] for name in same} | {"normalize_advantage": False}
    same = ("batch_size", "replay_capacity", "tau", "random_frames")
    frames = shared["num_envs"] * own["steps_per_batch"]
    common |= {name: own[name] for name in same} | {"updates_per_frame": own["gradient_steps"] / frames}
    if cell.algo.endswith("sac"):
        return common | gaussian | {"alpha_lr": own["lr"], "initial_alpha": own["initial_alpha"]}
    return common | {name: own[name] for name in ("initial_sigma", "final_sigma", "sigma_frames")}


def _text(value: object) -> str:
    return json.dumps(value) if not isinstance(value, str) else value


def rows(run_dir: Path) -> list[tuple[int, float, float]]:
    """Frames, mean return of an evaluation and seconds of collecting and learning until then."""
    seconds, training = {}, 0.0
    with (run_dir / "metrics.csv").open() as file:
        before = 0
        for row in csv.DictReader(file):
            frames = int(row["frames"])
            training += (frames - before) / float(row["frames_per_second"])
            seconds[frames], before = training, frames
    evaluations = [json.loads(line) for line in (run_dir / "evaluations.jsonl").read_text().splitlines()]
    return [(one["frames"], one["undiscounted_return"]["mean"], seconds[one["frames"]]) for one in evaluations]


def main() -> None:
    cell, threads = asked_for("softgm_bench", __doc__)
    with tempfile.TemporaryDirectory() as folder:
        train(compose(overrides(cell, folder, threads)))
        write(cell, rows(Path(folder)))


if __name__ == "__main__":
    sys.exit(main())
