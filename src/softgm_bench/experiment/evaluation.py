"""Vectorised evaluation: every environment counts exactly its first episode."""

import itertools
from dataclasses import asdict, dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp

from softgm_bench.envs import keys
from softgm_bench.rod.dense import dense

DISCOUNT = 0.99  # of the returns that are reported, whatever an algorithm trains with
# Of an episode, by name in its records: what is summed over its steps, of that what is divided by their number, what
# happened at any of them, and what was the case at the last one.
SUMMED = {
    "discounted_return": keys.REWARD,
    "undiscounted_return": keys.REWARD,
    "tip_travel_distance": keys.TIP_STEP,
    "torque_per_agent": keys.TORQUE_PER_AGENT,
    "torque_joint": keys.TORQUE_JOINT,
}
AVERAGED = frozenset({"torque_per_agent", "torque_joint"})
HAPPENED = {"success": keys.SUCCESS, "diverged": keys.DIVERGED}
LAST = {"final_distance": keys.DISTANCE}
LOOK_EVERY = 16  # steps between two looks at whether an episode goes on, on a device that a look waits for


@dataclass(frozen=True)
class EpisodeRecords:
    """One entry per episode in every field, ``(episodes,)``; None what the task does not tell.

    Attributes:
        discounted_return: sum of gamma^t r_t.
        undiscounted_return: sum of r_t.
        length: control steps.
        success: whether the tip reached the target.
        diverged: whether the simulation broke; never a success.
        tip_travel_distance: length of the tip's path, m.
        final_distance: tip to target at the end, m.
        torque_per_agent: mean over steps and agents of an agent's torque, N m.
        torque_joint: mean over steps of the norm over all agents and axes, N m.
    """

    discounted_return: NDArray[np.float64]
    undiscounted_return: NDArray[np.float64]
    length: NDArray[np.int64]
    success: NDArray[np.bool_] | None = None
    diverged: NDArray[np.bool_] | None = None
    tip_travel_distance: NDArray[np.float64] | None = None
    final_distance: NDArray[np.float64] | None = None
    torque_per_agent: NDArray[np.float64] | None = None
    torque_joint: NDArray[np.float64] | None = None

    def rows(self) -> list[dict[str, float | int]]:
        """One mapping per episode, of plain numbers."""
        columns = {name: values.tolist() for name, values in asdict(self).items() if values is not None}
        return [
            {"episode": index} | {name: values[index] for name, values in columns.items()}
            for index in range(len(self.length))
        ]


def evaluate(
    policy: TensorDictModuleBase, env: EnvBase, *, deterministic: bool, seed: int, gamma: float = DISCOUNT
) -> EpisodeRecords:
    """One episode in each of ``env``'s environments; the same seed gives the same episodes.

    Training is not disturbed: ``env`` must not be the training environment, and the global generator, on which a
    policy that samples draws, is put back.
    """
    exploration = ExplorationType.DETERMINISTIC if deterministic else ExplorationType.RANDOM
    devices = [env.device] if env.device is not None and env.device.type == "cuda" else []
    with torch.random.fork_rng(devices), torch.no_grad(), set_exploration_type(exploration):
        env.set_seed(seed)
        torch.manual_seed(seed)
        return _first_episodes(policy, env, gamma)


def _first_episodes(policy: TensorDictModuleBase, env: EnvBase, gamma: float) -> EpisodeRecords:
    data = env.reset()
    alive = torch.ones(env.batch_size, dtype=torch.bool, device=env.device)
    sums = {name: torch.zeros(env.batch_size, dtype=torch.float64, device=env.device) for name in SUMMED}
    length = torch.zeros(env.batch_size, dtype=torch.int64, device=env.device)
    happened = {name: torch.zeros_like(alive) for name in HAPPENED}
    last = {name: torch.zeros_like(sums["discounted_return"]) for name in LAST}
    told: set[NestedKey] = set()
    discount, blind = 1.0, dense(alive.device)
    for step in itertools.count():
        if not (blind and step % LOOK_EVERY) and not alive.any():
            break
        data = env.step(_act(policy, data, alive))
        after = data["next"]
        told = told or set(after.keys(include_nested=True))
        for name in [name for name in SUMMED if SUMMED[name] in told]:
            weight = discount if name == "discounted_return" else 1.0
            sums[name] += torch.where(alive, weight * after[SUMMED[name]].squeeze(-1).double(), 0.0)
        length += alive
        for name in [name for name in HAPPENED if HAPPENED[name] in told]:
            happened[name] |= alive & after[HAPPENED[name]].squeeze(-1)
        for name in [name for name in LAST if LAST[name] in told]:
            last[name] = torch.where(alive, after[LAST[name]].squeeze(-1).double(), last[name])
        alive = alive & ~after[keys.DONE].squeeze(-1)
        discount *= gamma
        data = step_mdp(data)
    for name in AVERAGED:
        sums[name] /= length
    results = {
        name: value.cpu().numpy()
        for name, value in (sums | happened | last).items()
        if (SUMMED | HAPPENED | LAST)[name] in told
    }
    return EpisodeRecords(length=length.cpu().numpy(), **results)


def _act(policy: TensorDictModuleBase, data: TensorDictBase, alive: torch.Tensor) -> TensorDictBase:
    """Actions of the environments whose first episode goes on; zeros, unpaid for, in the others.

    On a device that a look at ``alive`` waits for, all are paid for.
    """
    if dense(alive.device) or alive.all():
        return policy(data)
    action = policy(data[alive])[keys.ACTION]
    data[keys.ACTION] = action.new_zeros(*alive.shape, *action.shape[1:])
    data[keys.ACTION][alive] = action
    return data
