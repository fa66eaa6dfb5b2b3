"""The search: sequences of policies, then of neighbouring scenes, varied and selected.

An evolution strategy on whole sequences. A scene's candidates are what brought the tip nearest in it so far and what
succeeded in the scenes that are most like it, each with smooth noise added: a random value at a few knots for every
number of the action, linear between them. What succeeds in one scene is tried in its neighbours next, so successes
spread from easy scenes to hard ones.
"""

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp

from softgm_bench.certification.bench import Bench, to_tensor
from softgm_bench.envs import SoftArmEnv, entries
from softgm_bench.episodes.certified import Certified, dequantised, physics, quantised
from softgm_bench.episodes.evaluation import act

Array = NDArray[np.float32]

KEPT = 4  # best sequences of an unsolved scene that are varied further
NEIGHBOURS = 8  # solved scenes whose sequences are tried in a scene
AMPLITUDES = (0.05, 0.15, 0.4, 0.8)  # of the noise at a knot, one of these for each child
KNOTS = (2, 4, 8)  # of the noise, one of these numbers for each child


class Search:
    """The state of a search in the scenes of a bench.

    Attributes:
        bench: float32, to search with.
        judge: the same scenes in float64, which decides.
        length: of the sequence that succeeds in each scene, ``(scenes,)`` int64; 0: none is known.
        action: these sequences, padded with their last action, ``(scenes, T, N, 2)`` int8.
        tried: sequences that were played in each scene, ``(scenes,)`` int64.
    """

    def __init__(self, bench: Bench, judge: Bench, steps: int, seed: int = 0) -> None:
        """Begin with nothing known; sequences of ``steps`` control steps at most."""
        self.bench, self.judge, n_agents = bench, judge, bench.env.sizes.n_agents
        self._generator = torch.Generator().manual_seed(seed)
        self.length = torch.zeros(bench.scenes, dtype=torch.int64)
        self.action = torch.zeros((bench.scenes, steps, n_agents, 2), dtype=torch.int8)
        self.tried = torch.zeros(bench.scenes, dtype=torch.int64)
        self._best = torch.zeros((bench.scenes, KEPT, steps, n_agents, 2), dtype=torch.int8)
        self._left = torch.full((bench.scenes, KEPT), torch.inf, dtype=torch.float64)
        places = described(bench.privileged, bench.target)
        self._apart = torch.cdist(places, places)

    @property
    def open(self) -> Tensor:
        """Scenes without a sequence that succeeds."""
        return (self.length == 0).nonzero().squeeze(-1)

    def take(self, known: Certified) -> None:
        """Go on from what an earlier search found; what does not succeed any more is searched again."""
        steps = self.action.shape[1]
        rows = torch.from_numpy(np.flatnonzero((known.length > 0) & (known.length <= steps)))
        action = (
            torch.stack([_padded(quantised(known.actions(int(row))), steps) for row in rows]) if len(rows) else None
        )
        self.tried.copy_(to_tensor(known.tried))
        if action is not None:
            self._decide(rows, action)

    def follow(self, policy: TensorDictModuleBase, sampled: bool, seed: int = 0) -> None:
        """Let a policy act in all scenes that are open, and try what it did."""
        rows = self.open
        if not len(rows):
            return
        action = rollout(policy, self.judge.env, rows, self.action.shape[1], sampled, seed)
        self._try(rows, action)

    def borrow(self, other: Certified, scenes: Array, nearest: int) -> None:
        """Try what succeeds in scenes of another task that are most like each open one.

        Args:
            other: its scenes.
            scenes: what ``other`` tells of them, as ``described`` gives it.
            nearest: sequences to try in each open scene.
        """
        rows, steps = self.open, self.action.shape[1]
        known = torch.from_numpy(np.flatnonzero((other.length > 0) & (other.length <= steps)))
        if not len(rows) or not len(known):
            return
        apart = torch.cdist(described(self.bench.privileged, self.bench.target)[rows], to_tensor(scenes)[known])
        chosen = known[apart.argsort(dim=1)[:, :nearest]]
        action = [_padded(quantised(other.actions(int(scene))), steps) for scene in chosen.flatten()]
        self._try(rows.repeat_interleave(chosen.shape[1]), torch.stack(action))

    def generation(self, children: int, scenes: int | None = None) -> None:
        """Try so many new sequences in each open scene; in ``scenes`` of them, drawn at random, if that is less."""
        rows = self.open
        if scenes is not None and len(rows) > scenes:
            rows = rows[torch.randperm(len(rows), generator=self._generator)[:scenes]]
        if len(rows):
            self._try(rows.repeat_interleave(children), self._children(rows, children))

    def found(self, task: str, seed: int) -> Certified:
        """Give what is known as a file holds it."""
        rows = (self.length > 0).nonzero().squeeze(-1).tolist()
        parts = [self.action[row, : int(self.length[row])] for row in rows]
        return Certified(
            task=task,
            seed=seed,
            physics=physics(self.judge.env),
            target=self.judge.target.to(torch.float32).numpy(),
            privileged=self.judge.privileged.to(torch.float32).numpy(),
            length=self.length.numpy(),
            action=torch.cat(parts).numpy() if parts else self.action[0, :0].numpy(),
            tried=self.tried.numpy(),
        )

    def _try(self, rows: Tensor, action: Tensor) -> None:
        played = self.bench.play(rows, action)
        self.tried.index_add_(0, rows, torch.ones_like(rows))
        for row in rows.unique().tolist():
            mine = (rows == row).nonzero().squeeze(-1)
            left = torch.cat([self._left[row], played.left[mine]])
            order = left.argsort()[:KEPT]
            self._left[row] = left[order]
            self._best[row] = torch.cat([self._best[row], action[mine]])[order]
        won = played.success.nonzero().squeeze(-1)
        won = won[played.length[won].argsort(descending=True)]
        if len(won):
            first = {int(rows[i]): i for i in won.tolist()}  # the shortest one of each scene
            chosen = torch.tensor(list(first.values()))
            self._decide(rows[chosen], action[chosen])

    def _decide(self, rows: Tensor, action: Tensor) -> None:
        """Keep what succeeds in float64 too."""
        played = self.judge.play(rows, action)
        rows, action, length = rows[played.success], action[played.success], played.length[played.success]
        self.length[rows], self.action[rows] = length, action

    def _children(self, rows: Tensor, children: int) -> Tensor:
        """Vary parents of each row, ``(rows * children, T, N, 2)`` int8: half of them its own, half its neighbours'."""
        solved = (self.length > 0).nonzero().squeeze(-1)
        parents = torch.stack([self._parents(row, solved, children) for row in rows.tolist()]).flatten(0, 1)
        return quantised(dequantised(parents) + self._noise(len(parents), *parents.shape[1:]))

    def _parents(self, row: int, solved: Tensor, children: int) -> Tensor:
        own = self._best[row][self._left[row].isfinite()]
        pool = [own] if len(own) else []
        if len(solved):
            near = solved[self._apart[row, solved].argsort()[:NEIGHBOURS]]
            pool.append(self.action[near])
        if not pool:
            return self._best[row][:1].expand(children, -1, -1, -1)
        chosen = []
        for child in range(children):
            of = pool[child % len(pool)]
            one, other = (of[self._draw(len(of))] for _ in range(2))
            # halfway between two sequences is often a sequence that goes halfway between
            chosen.append(quantised(0.5 * (dequantised(one) + dequantised(other))) if self._draw(3) == 0 else one)
        return torch.stack(chosen)

    def _noise(self, count: int, steps: int, *shape: int) -> Tensor:
        out = torch.empty((count, steps, *shape))
        kinds = torch.randint(len(KNOTS), (count,), generator=self._generator)
        for kind, knots in enumerate(KNOTS):
            mine = (kinds == kind).nonzero().squeeze(-1)
            if not len(mine):
                continue
            at_knots = torch.randn((len(mine), int(np.prod(shape)), knots), generator=self._generator)
            smooth = torch.nn.functional.interpolate(at_knots, size=steps, mode="linear", align_corners=True)
            out[mine] = smooth.mT.reshape(len(mine), steps, *shape)
        amplitude = torch.tensor(AMPLITUDES)[torch.randint(len(AMPLITUDES), (count,), generator=self._generator)]
        return out * amplitude.view(-1, *[1] * (1 + len(shape)))

    def _draw(self, below: int) -> int:
        return int(torch.randint(below, (), generator=self._generator))


def described(privileged: Tensor, target: Tensor) -> Tensor:
    """Describe scenes by what sequences depend on: a wall's opening, if there is one, and the target, m, float64."""
    return torch.cat([privileged[:, :3], target], dim=-1).double()


def rollout(
    policy: TensorDictModuleBase, env: SoftArmEnv, rows: Tensor, steps: int, sampled: bool, seed: int
) -> Tensor:
    """What a policy does in the scenes ``rows`` of an environment at its beginning, ``(len(rows), steps, N, 2)`` int8.

    Actions are rounded before they act. Afterwards the environment is at its beginning again.
    """
    beginning = env.simulation_state()
    exploration = ExplorationType.RANDOM if sampled else ExplorationType.DETERMINISTIC
    alive = torch.zeros(env.batch_size, dtype=torch.bool)
    alive[rows] = True
    env.simulator.state.episodes.truncated = ~alive
    taken = torch.zeros((steps, *env.batch_size, env.sizes.n_agents, 2), dtype=torch.int8)
    with torch.random.fork_rng([]), torch.no_grad(), set_exploration_type(exploration):
        torch.manual_seed(seed)
        episodes = env.simulator.state.episodes
        data = env._first_frame(episodes, env.simulator.sense(episodes))
        for k in range(steps):
            if not alive.any():
                break
            data = act(policy, data, alive)
            taken[k] = quantised(data[entries.ACTION])
            data = env.step(data.set(entries.ACTION, dequantised(taken[k])))
            alive = alive & ~data["next", entries.DONE].squeeze(-1)
            data = step_mdp(data)
    env.load_simulation_state(beginning)
    return taken.transpose(0, 1)[rows].contiguous()


def run(search: Search, out_of_time: Callable[[], bool], children: int, after: Callable[[], None]) -> None:
    """Let generations follow each other until every scene is certified or time is up; ``after`` each of them."""
    while len(search.open) and not out_of_time():
        search.generation(children, scenes=max(1, 2048 // children))
        after()


def _padded(action: Tensor, steps: int) -> Tensor:
    return torch.cat([action, action[-1:].expand(steps - len(action), -1, -1)])
