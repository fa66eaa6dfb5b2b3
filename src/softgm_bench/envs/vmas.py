"""VMAS tasks as TorchRL environments: other people's tasks, on which our algorithms can be held against other people's.

VMAS (Bettini et al., 2022) simulates point masses in the plane, batched over environments. It is an optional extra.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded

from softgm_bench.envs import entries
from softgm_bench.envs.interface import Kind, Settings, Sizes, register_kind
from softgm_bench.envs.remembering import RememberingEnv

OBSERVATION = ("agents", "observation")  # (B, N, F) float32: all that an agent observes
DIRECTIONS = 2  # of a force in the plane
SCENARIOS = {"vmas_balance": "balance", "vmas_navigation": "navigation"}


@dataclass
class VmasConfig:
    """A VMAS task; values in ``conf/task``.

    Attributes:
        name: a key of ``SCENARIOS``.
        horizon: steps until an episode ends.
        limit_terminates: the horizon is reported as a termination, which ends the value of the state, as TorchRL's
            ``VmasEnv`` and with it BenchMARL do; otherwise as a truncation.
        scenario: arguments of VMAS's scenario.
    """

    name: str
    horizon: int
    limit_terminates: bool
    scenario: dict[str, Any]

    def __post_init__(self) -> None:
        """Refuse values that describe no task.

        Raises:
            ValueError: with one line naming the key, its value and what would be right.
        """
        if self.horizon < 1:
            raise ValueError(f"task.horizon is {self.horizon}: it must be at least 1")


class VmasEnv(RememberingEnv):
    """A VMAS scenario with ``batch_size=(num_envs,)``: entry ``OBSERVATION`` and those of ``entries`` that fit.

    The reward is the team's, the mean over agents of VMAS's rewards. TorchRL's own ``VmasEnv`` resets one environment
    after another in Python; here the states of a full, batched reset are kept in store, and an environment that begins
    again takes the next of them. States are drawn from a generator of the environment's own.

    Attributes:
        sizes: of its actions and observations.
        horizon: steps until an episode ends.
    """

    def __init__(self, config: VmasConfig, num_envs: int, seed: int, horizon: int | None = None) -> None:
        """Build the environments on the CPU.

        Args:
            config: the task.
            num_envs: environments simulated at once.
            seed: of the environment's own generator.
            horizon: steps until an episode ends, the task's by default.

        Raises:
            ValueError: VMAS is not installed.
        """
        super().__init__(device=torch.device("cpu"), batch_size=torch.Size([num_envs]))
        self.horizon = config.horizon if horizon is None else horizon
        self.limit_terminates = config.limit_terminates
        self._set_seed(seed)
        self.scenario = _make_scenario(SCENARIOS[config.name], num_envs, config.scenario)
        self.agents = self.scenario.world.policy_agents
        # of a state, everything that a reset writes; the rest VMAS computes anew in every step
        self._names = [name for name, _ in self._state()]
        self._observation = self._observe()
        self.sizes = Sizes(len(self.agents), DIRECTIONS, n_features=self._observation.shape[-1])
        self._steps = torch.zeros(num_envs, dtype=torch.int64)
        self._terminated = torch.zeros(num_envs, dtype=torch.bool)
        self._truncated = torch.zeros(num_envs, dtype=torch.bool)
        self._store: list[Tensor] = []  # states to begin with, observations last
        self._taken = num_envs  # of the store
        self._make_specs()

    def _make_specs(self) -> None:
        size, n_agents = self.batch_size[0], self.sizes.n_agents

        def flag() -> Binary:
            return Binary(shape=(size, 1), dtype=torch.bool)

        observation = Unbounded(shape=(size, n_agents, self.sizes.n_features), dtype=torch.float32)
        action = Bounded(-1.0, 1.0, shape=(size, n_agents, self.sizes.action), dtype=torch.float32)
        self.observation_spec = Composite(
            agents=Composite(observation=observation, shape=(size, n_agents)), is_init=flag(), shape=(size,)
        )
        self.action_spec = Composite(agents=Composite(action=action, shape=(size, n_agents)), shape=(size,))
        self.reward_spec = Unbounded(shape=(size, 1), dtype=torch.float32)
        self.done_spec = Composite(done=flag(), terminated=flag(), truncated=flag(), shape=(size,))

    # TorchRL's contract

    def _set_seed(self, seed: int | None) -> None:
        if seed is not None:
            with torch.random.fork_rng([]):
                torch.manual_seed(seed)
                self._generator = torch.get_rng_state()
            self._taken = self.batch_size[0]

    def _reset(self, tensordict: TensorDictBase | None = None, seed: int | None = None, **kwargs) -> TensorDict:
        self._set_seed(seed)
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if mask is not None:
            self._begin_again(mask.reshape(-1))
        else:
            self._draw()
            self._observation = self._observe()
            for tensor in (self._steps, self._terminated, self._truncated):
                tensor.zero_()
            self._taken = self.batch_size[0]
        return self._frame()

    def maybe_reset(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Do what ``EnvBase.maybe_reset`` does, at less cost."""
        done = tensordict.get(entries.DONE)
        if bool(done.any()):
            self._begin_again(done.reshape(-1))
            tensordict.update(self._frame())
        return tensordict

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        world = self.scenario.world
        action = tensordict.get(entries.ACTION).clamp(-1.0, 1.0)
        for agent, of_agent in zip(self.agents, action.unbind(1), strict=True):
            agent.action.u = of_agent * (agent.action.u_range_tensor * agent.action.u_multiplier_tensor)
        for agent in world.agents:
            self.scenario.env_process_action(agent)
        self.scenario.pre_step()
        world.step()
        self.scenario.post_step()
        reward = torch.stack([self.scenario.reward(agent) for agent in self.agents]).mean(0)
        self._observation = self._observe()
        self._steps = self._steps + 1
        limit, ended = self._steps >= self.horizon, self.scenario.done()
        self._terminated = ended | limit if self.limit_terminates else ended.clone()
        self._truncated = limit & ~self._terminated
        return self._frame().set(entries.REWARD, reward.unsqueeze(-1))

    def _frame(self) -> TensorDict:
        """Observation and flags as they stand, in tensors that later steps do not write to."""
        terminated, truncated = self._terminated.unsqueeze(-1), self._truncated.unsqueeze(-1)
        agents = TensorDict({"observation": self._observation.clone()}, (*self.batch_size, self.sizes.n_agents))
        flags = {"terminated": terminated.clone(), "truncated": truncated.clone(), "done": terminated | truncated}
        flags |= {"is_init": (self._steps == 0).unsqueeze(-1)}
        return TensorDict({"agents": agents, **flags}, self.batch_size, device=self.device)

    def _observe(self) -> Tensor:
        return torch.stack([self.scenario.observation(agent) for agent in self.agents], dim=1)

    # where episodes begin

    def _draw(self) -> None:
        """Begin a new episode in every environment."""
        with torch.random.fork_rng([]):
            torch.set_rng_state(self._generator)
            self.scenario.env_reset_world_at(env_index=None)
            self._generator = torch.get_rng_state()

    def _begin_again(self, mask: Tensor) -> None:
        """Replace the episodes in ``mask``, ``(num_envs,)``, by new ones."""
        rows = mask.nonzero().squeeze(-1)
        while len(rows):
            if self._taken == self.batch_size[0]:
                self._restock()
            now, rows = rows.split([count := min(len(rows), self.batch_size[0] - self._taken), len(rows) - count])
            fresh = slice(self._taken, self._taken + count)
            self._taken += count
            self._write(
                [old.index_copy(0, now, new[fresh]) for old, new in zip(self._read(), self._store, strict=True)]
            )
        for tensor in (self._steps, self._terminated, self._truncated):
            tensor.masked_fill_(mask, 0)

    def _restock(self) -> None:
        """Fill the store by a full reset, and leave the running episodes as they are."""
        running = [tensor.clone() for tensor in self._read()]
        self._draw()
        self._observation = self._observe()
        self._store = [tensor.clone() for tensor in self._read()]
        self._write(running)
        self._taken = 0

    def _read(self) -> list[Tensor]:
        """The running episodes: VMAS's state in the order of ``_names``, and the observation."""
        state = dict(self._state())
        return [*(state[name] for name in self._names), self._observation]

    def _write(self, tensors: list[Tensor]) -> None:
        holders = dict(self._holders())
        for (holder, attribute), tensor in zip(self._names, tensors[:-1], strict=True):
            setattr(holders[holder], attribute, tensor)
        self._observation = tensors[-1]

    def _state(self) -> Iterator[tuple[tuple[str, str], Tensor]]:
        """Every tensor ``(num_envs, ...)`` of the scenario, its entities and their physical states, by name."""
        for holder, thing in self._holders():
            for attribute, value in vars(thing).items():
                if isinstance(value, Tensor) and value.ndim and value.shape[0] == self.batch_size[0]:
                    yield (holder, attribute), value

    def _holders(self) -> Iterator[tuple[str, Any]]:
        yield "scenario", self.scenario
        for entity in self.scenario.world.entities:
            yield entity.name, entity
            yield f"{entity.name}.state", entity.state

    # what checkpoints need

    def generator_state(self) -> Tensor:
        """State of the generator that episodes are drawn from."""
        return self._generator.clone()

    def set_generator_state(self, state: Tensor) -> None:
        """Resume drawing from what ``generator_state`` returned."""
        self._generator = state.clone()

    def simulation_state(self) -> TensorDict:
        """A copy of all episodes as they stand, and of those in store."""
        state = {f"state{index}": tensor.clone() for index, tensor in enumerate(self._read())}
        state |= {f"store{index}": tensor.clone() for index, tensor in enumerate(self._store)}
        state |= {"steps": self._steps.clone(), "terminated": self._terminated.clone()}
        state["truncated"] = self._truncated.clone()
        state["taken"] = torch.full((self.batch_size[0],), self._taken)
        return TensorDict(state, self.batch_size)

    def load_simulation_state(self, state: TensorDictBase) -> None:
        """Resume from what ``simulation_state`` returned for as many environments of the same task."""
        entries = len(self._names) + 1
        self._write([state[f"state{index}"].clone() for index in range(entries)])
        self._store = [state[f"store{index}"].clone() for index in range(entries) if f"store{index}" in state]
        self._steps, self._taken = state["steps"].clone(), int(state["taken"][0])
        self._terminated, self._truncated = state["terminated"].clone(), state["truncated"].clone()


def _make_scenario(name: str, num_envs: int, arguments: dict[str, Any]) -> Any:
    """A scenario of VMAS with its world, whose episodes have begun.

    Raises:
        ValueError: VMAS is not installed.
    """
    try:
        import vmas
    except ImportError as error:
        raise ValueError(f"task=vmas_{name} needs VMAS: pip install '.[vmas]'") from error
    return vmas.make_env(name, num_envs=num_envs, device="cpu", **arguments).scenario


def _build(settings: Settings, num_envs: int, seed: int, horizon: int | None, training: bool) -> VmasEnv:
    return VmasEnv(settings.task, num_envs, seed, horizon)


def _check(settings: Settings) -> None:
    """Refuse what only the arm has.

    Raises:
        ValueError: with one line naming the key, its value and what would be right.
    """
    task = f"task={settings.task.name}"
    if settings.device != "cpu":
        raise ValueError(f"device={settings.device}: {task} runs on the CPU")
    if not settings.perturbation.nothing:
        raise ValueError(f"perturbation={settings.perturbation.name}: {task} has no arm; it must be none")
    if not settings.randomise.nothing:
        raise ValueError(f"randomise={settings.randomise.name}: {task} has no arm; it must be none")
    if settings.oracle:
        raise ValueError(f"observation=oracle: {task} has nothing that an oracle would be told")


VMAS = register_kind(
    Kind(
        base=VmasConfig,
        configs=lambda: dict.fromkeys(SCENARIOS, VmasConfig),
        build=_build,
        sizes=lambda config: VmasEnv(config, 1, 0).sizes,
        check=_check,
        has_arm=False,
    )
)
