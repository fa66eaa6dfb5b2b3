"""The beginning of a run with a trained policy instead of fresh networks."""

from pathlib import Path
from typing import Any

from softgm_bench.config import Config, plain
from softgm_bench.config.comparison import as_written, differences
from softgm_bench.episodes import policy
from softgm_bench.errors import UserError
from softgm_bench.runs.run import Run

# What may differ: it says how widely the policy explores, not what its parameters mean.
EXPLORATION = ("algo.actor.initial_sigma", "algo.actor.min_sigma", "algo.actor.max_sigma")


def begin(run: Run, resumed: bool) -> None:
    """Put the actor of ``start.policy`` into a run that has just been built; nothing is done where there is none.

    Args:
        run: whose algorithm then holds its actor still for ``start.critic_frames``.
        resumed: the run comes from a checkpoint, which has everything else.

    Raises:
        UserError: the algorithm cannot do that, or there is no policy, or one with other networks.
    """
    config = run.config
    if config.start.policy is None:
        return
    name, algorithm = config.start.policy, run.algorithm
    if not hasattr(algorithm, "begin_with"):
        raise UserError(f"start.policy={name}: algo={config.algo.name} cannot begin with a trained policy")
    if resumed:
        algorithm.begin_with(None, config.start.critic_frames)
        return
    trained = policy.load(Path(name), config.device)
    refuse_other_networks(name, trained.run, config)
    try:
        algorithm.begin_with(trained.policy.state_dict(), config.start.critic_frames)
    except RuntimeError as error:  # torch names every parameter, over many lines
        here = f"algo={config.algo.name} task={config.task.name}"
        raise UserError(f"start.policy={name}: its networks do not fit those of {here}") from error
    run.start = {"policy": name, "fingerprint": policy.fingerprint(trained), "frames": trained.frames}


def refuse_other_networks(name: str, held: Config, config: Config) -> None:
    """Hold the settings that parameters get their meaning from against those of the run that trained a policy.

    Raises:
        UserError: naming the first that differs.
    """
    wanted, there = (_networks(one) for one in (config, held))
    for key, pair in differences(wanted, there, EXPLORATION).items():
        ours, theirs = map(as_written, pair)
        raise UserError(f"start.policy={name}: it was trained with {key}={theirs}, which is {ours} here")


def _networks(config: Config) -> dict[str, Any]:
    values = plain(config)
    algo = {"actor": values["algo"].get("actor")}
    return {"observation": values["observation"], "model": values["model"], "algo": algo}
