"""Settings that earlier versions wrote down, in today's words: run folders, checkpoints and files of policies."""

from collections.abc import Mapping
from typing import Any

# Keys that earlier versions did not have, with the values that leave everything as it was. An unknown recipe or
# experiment has no name; the training horizon of such a run stands in its experiment.
NEUTRAL: dict[str, Any] = {
    "recipe": "",
    "resume": False,
    "compile": None,
    "matmul": None,
    "start.policy": None,
    "start.critic_frames": 0,
    "experiment.name": "",
    "experiment.minutes": None,
    "task.train_horizon": None,
    "task.hidden_scene": False,
    "task.max_contact_steps": None,
    "task.contact_counts": "at_end",
    "task.friction_coefficient": None,
    "task.velocity_damping_coefficient": None,
    "task.reward.lambda_fail": 0.0,
    "task.curriculum.easier_share": 0.0,
    "task.curriculum.easy_contact_steps": None,
    "task.curriculum.contact_stages": 0,
    "task.curriculum.easy_lambda_c": None,
    "task.curriculum.easy_target_offset": 0.0,
    "task.curriculum.target_power": 1.0,
    "algo.actor.embedding_norm": False,
    "algo.critic.embedding_norm": False,
    "algo.actor.hidden_norm": False,
    "algo.critic.hidden_norm": False,
    "algo.actor.relative_points": False,
    "model.remember": False,
    "algo.actor.memory": None,
    "algo.actor.mirror": None,
}
ABLATIONS = ("softgm_no_stage1", "softgm_no_stage2")  # algorithms then, models of the algorithm softgm now


def upgraded(values: Mapping[str, Any]) -> dict[str, Any]:
    """Plain values of a configuration with today's names; those of today come back as they are."""
    algo = values.get("algo")
    if not isinstance(algo, Mapping):
        return dict(values)
    actor = algo.get("actor")
    if isinstance(actor, Mapping) and isinstance(actor.get("mirror"), bool):  # there was one way to mirror
        algo = dict(algo) | {"actor": dict(actor) | {"mirror": "average" if actor["mirror"] else None}}
    if algo.get("name") not in ABLATIONS:
        return dict(values) | {"algo": algo}
    model = dict(values.get("model") or {}) | {"name": algo["name"]}
    return dict(values) | {"algo": dict(algo) | {"name": "softgm"}, "model": model}
