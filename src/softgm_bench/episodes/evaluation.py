"""Vectorised evaluation: every environment counts exactly its first episode."""

import itertools
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp

from softgm_bench.envs import keys
from softgm_bench.rod.dense import dense

DISCOUNT = 0.99  # of the returns that are reported, whatever an algorithm trains with
# Of an episode, by name in its records: what is summed over its steps, the discounted return first; of that what is
# divided by their number; at how many steps something was above 0; what happened at any of them; and what was the case
# at the last one.
SUMMED: dict[str, NestedKey] = {
    "discounted_return": keys.REWARD,
    "undiscounted_return": keys.REWARD,
    "tip_travel_distance": keys.TIP_STEP,
    "torque_per_agent": keys.TORQUE_PER_AGENT,
    "torque_joint": keys.TORQUE_JOINT,
    **{f"reward_{name}": (keys.REWARD_TERMS, name) for name in keys.REWARD_TERM_NAMES},
}
AVERAGED = frozenset({"torque_per_agent", "torque_joint"})
COUNTED: dict[str, NestedKey] = {"contact_steps": keys.CONTACT_NODES}
HAPPENED: dict[str, NestedKey] = {"success": keys.SUCCESS, "diverged": keys.DIVERGED}
LAST: dict[str, NestedKey] = {
    "final_distance": keys.DISTANCE,
    "discovered_bins": keys.DISCOVERED,
    "dropped_bins": keys.DROPPED,
}
WHOLE = frozenset({"discovered_bins", "dropped_bins"})
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
        contact_steps: control steps at whose end any node touched an obstacle.
        discovered_bins: in the table of obstacles at the end.
        dropped_bins: that the table had no slot for.
        reward_distance: sum over steps of the reward's term of this name, as all that follow.
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
    contact_steps: NDArray[np.int64] | None = None
    discovered_bins: NDArray[np.int64] | None = None
    dropped_bins: NDArray[np.int64] | None = None
    reward_distance: NDArray[np.float64] | None = None
    reward_progress: NDArray[np.float64] | None = None
    reward_smoothness: NDArray[np.float64] | None = None
    reward_time: NDArray[np.float64] | None = None
    reward_collision: NDArray[np.float64] | None = None
    reward_discovery: NDArray[np.float64] | None = None
    reward_stuck: NDArray[np.float64] | None = None
    reward_success: NDArray[np.float64] | None = None

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


def evaluate_in_parts(
    policy: TensorDictModuleBase,
    build: Callable[[int, int], EnvBase],
    episodes: int,
    *,
    deterministic: bool,
    seed: int,
    gamma: float = DISCOUNT,
    at_once: int | None = None,
) -> EpisodeRecords:
    """``episodes`` episodes; with the same ``at_once``, the same seed gives the same ones.

    Args:
        policy: to be evaluated.
        build: makes an environment of so many environments with a seed.
        episodes: how many.
        deterministic: take the policy's mean instead of a sample.
        seed: from which all seeds are derived; see ``evaluation_seed``.
        gamma: of the discounted return.
        at_once: environments simulated side by side, to save memory; None: all.
    """
    size = at_once or episodes
    parts = []
    for part, first in enumerate(range(0, episodes, size)):
        own = evaluation_seed(seed, part)
        env = build(min(size, episodes - first), own)
        parts.append(asdict(evaluate(policy, env, deterministic=deterministic, seed=own, gamma=gamma)))
    columns = {name: [part[name] for part in parts] for name, values in parts[0].items() if values is not None}
    return EpisodeRecords(**{name: np.concatenate(values) for name, values in columns.items()})


def evaluation_seed(seed: int, part: int = 0) -> int:
    """Seed of the environments of an evaluation's part, independent of everything that any training draws."""
    return int(np.random.SeedSequence(seed, spawn_key=(2, part)).generate_state(1)[0])


def _first_episodes(policy: TensorDictModuleBase, env: EnvBase, gamma: float) -> EpisodeRecords:
    data = env.reset()
    alive = torch.ones(env.batch_size, dtype=torch.bool, device=env.device)
    tally: _Tally | None = None
    blind = dense(alive.device)
    for step in itertools.count():
        if not (blind and step % LOOK_EVERY) and not alive.any():
            break
        data = env.step(act(policy, data, alive))
        after = data["next"]
        tally = tally or _Tally(after, gamma)
        tally.add(after, alive)
        alive = alive & ~after[keys.DONE].squeeze(-1)
        data = step_mdp(data)
    assert tally is not None
    return tally.records()


class _Tally:
    """Adds up what episodes say of themselves."""

    def __init__(self, frame: TensorDictBase, gamma: float) -> None:
        """Begin with nothing; ``frame``, ``(episodes,)``, shows what there is to add up."""
        told = set(frame.keys(include_nested=True))
        kinds = (SUMMED, COUNTED, HAPPENED, LAST)
        self._summed, self._counted, self._happened, self._last = (
            {name: key for name, key in kind.items() if key in told} for kind in kinds
        )
        (episodes,), device = frame.batch_size, frame.device
        self._sums = torch.zeros((episodes, len(self._summed)), dtype=torch.float64, device=device)
        self._weight = torch.ones(len(self._summed), dtype=torch.float64, device=device)
        self._gamma = gamma
        self._counts = torch.zeros((episodes, 1 + len(self._counted)), dtype=torch.int64, device=device)
        self._ever = torch.zeros((episodes, len(self._happened)), dtype=torch.bool, device=device)
        self._ends = torch.zeros((episodes, len(self._last)), dtype=torch.float64, device=device)

    def add(self, frame: TensorDictBase, alive: Tensor) -> None:
        """Add a step of the episodes in ``alive``, ``(episodes,)``."""
        going = alive.unsqueeze(-1)
        self._sums += torch.where(going, _columns(frame, self._summed).double() * self._weight, 0.0)
        self._weight[0] *= self._gamma
        self._counts[:, :1] += going
        if self._counted:
            self._counts[:, 1:] += going & (_columns(frame, self._counted) > 0)
        if self._happened:
            self._ever |= going & _columns(frame, self._happened)
        if self._last:
            self._ends = torch.where(going, _columns(frame, self._last).double(), self._ends)

    def records(self) -> EpisodeRecords:
        """All that has been added."""
        length = self._counts[:, 0]
        columns = {
            **_split(self._summed, self._sums),
            **_split(("length", *self._counted), self._counts),
            **_split(self._happened, self._ever),
            **_split(self._last, self._ends),
        }
        columns |= {name: columns[name] / length for name in AVERAGED & columns.keys()}
        columns |= {name: columns[name].long() for name in WHOLE & columns.keys()}
        return EpisodeRecords(**{name: values.cpu().numpy() for name, values in columns.items()})


def _columns(frame: TensorDictBase, entries: Mapping[str, NestedKey]) -> Tensor:
    """Entries ``(episodes, 1)`` side by side."""
    return torch.cat([frame.get(key) for key in entries.values()], dim=-1)


def _split(names: Iterable[str], columns: Tensor) -> dict[str, Tensor]:
    return dict(zip(names, columns.unbind(-1), strict=True))


def act(policy: TensorDictModuleBase, data: TensorDictBase, alive: Tensor) -> TensorDictBase:
    """Actions of the environments whose first episode goes on; zeros, unpaid for, in the others.

    On a device that a look at ``alive`` waits for, all are paid for.
    """
    if dense(alive.device) or alive.all():
        return policy(data)
    action = policy(data[alive])[keys.ACTION]
    data[keys.ACTION] = action.new_zeros(*alive.shape, *action.shape[1:])
    data[keys.ACTION][alive] = action
    return data
