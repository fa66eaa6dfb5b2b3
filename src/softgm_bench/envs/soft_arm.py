"""``SoftArmEnv``: N sections of one Cosserat-rod arm as cooperating agents, batched over environments."""

from collections.abc import Mapping
from contextlib import AbstractContextManager

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor

from softgm_bench.envs import entries
from softgm_bench.envs.interface import Sizes
from softgm_bench.envs.perturbation import PerturbationConfig
from softgm_bench.envs.remembering import RememberingEnv
from softgm_bench.envs.section_mixture import numbers_of
from softgm_bench.envs.sensing import Sight
from softgm_bench.envs.simulation import Episodes, Simulator
from softgm_bench.envs.specs import make_specs
from softgm_bench.envs.tasks.base import Scene, Task
from softgm_bench.rod import sync
from softgm_bench.rod.actuation import DIRECTIONS
from softgm_bench.rod.backend import Backend
from softgm_bench.rod.randomise import RandomiseConfig
from softgm_bench.rod.state import RodState
from softgm_bench.upstream import graphs


def sizes_of(task: Task) -> Sizes:
    """Give the sizes of a task's actions and observations; of a mixture, those of the arms with most sections."""
    n_slots = task.config.slots if task.max_cylinders else 0
    n_agents = max(numbers_of(task.config), default=task.config.n_agents)
    return Sizes(
        n_agents,
        DIRECTIONS,
        n_slots=n_slots,
        n_privileged=task.n_privileged,
        n_points=task.n_points,
        privileged_image=task.privileged_image,
    )


class SoftArmEnv(RememberingEnv):
    """A TorchRL environment with ``batch_size=(num_envs,)``; entries and shapes in ``softgm_bench.envs.entries``.

    One step is one control step of the rod. An environment that is done does not move until it is reset. Resets are
    partial (TorchRL's ``_reset`` mask) and draw scenes from the environment's own generator. A state that is not
    finite, or an element whose dilatation leaves the task's range, terminates that environment alone as ``diverged``;
    its last good state is what is observed. Where the task limits contact, the step in which an arm has touched
    obstacles at the end of more control steps than ``max_contact_steps`` ends its episode as failed.

    Attributes:
        sizes: of actions and observations.
        horizon: control steps until truncation.
        simulator: moves the arms; its ``state`` is all that changes.
    """

    def __init__(
        self,
        task: Task,
        backend: Backend,
        num_envs: int,
        seed: int,
        horizon: int | None = None,
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float64,
        stagger: bool = False,
        perturbation: PerturbationConfig | None = None,
        randomise: RandomiseConfig | None = None,
    ) -> None:
        """Build the environments; the first ``reset`` draws their scenes.

        Args:
            task: what is drawn and rewarded.
            backend: the rod's implementation.
            num_envs: environments simulated at once.
            seed: of the environment's own generator.
            horizon: control steps until truncation, the task's by default.
            device: of the simulation and of all entries.
            dtype: of the rod's state; entries that policies read are float32.
            stagger: for training; a full reset starts the episodes' clocks at random steps, so that their truncations
                do not fall together and every batch of training holds all phases of an episode. The first scenes are
                then not those of ``set_seed``: some were drawn while building, as in all trainings of before.
            perturbation: of observations, sections and tip, none by default.
            randomise: ranges from which every episode's body is drawn; by default all arms are the nominal one.

        Raises:
            ValueError: the perturbation is of a section that does not exist.
        """
        super().__init__(device=torch.device(device), batch_size=torch.Size([num_envs]))
        self.horizon: int = task.config.horizon if horizon is None else horizon
        self.sizes = sizes_of(task)
        self.task = task
        self._stagger = stagger
        self.simulator = Simulator(
            task, backend, num_envs, seed, self.horizon, self.device, dtype, perturbation, randomise
        )
        if not stagger:
            self.simulator.seed(seed)  # a seed means the same scenes here as in ``set_seed``
        curriculum, perturbed = self.simulator.curriculum, self.simulator.perturbation is not None
        self._never = torch.zeros(num_envs, dtype=torch.bool, device=self.device)  # a step begins no episode
        self._limited = task.config.max_contact_steps is not None
        specs = make_specs(
            num_envs,
            self.sizes,
            self.device,
            curriculum=curriculum,
            perturbed=perturbed,
            contact_limit=self._limited,
            bodies=self.simulator.randomise is not None,
        )
        for name, spec in specs.items():
            setattr(self, name, spec)

    # the simulation as it is, for those who record or draw it; nothing here is a copy

    @property
    def backend(self) -> Backend:
        """The rod's implementation."""
        return self.simulator.backend

    @property
    def rod(self) -> RodState:
        """The arms' states."""
        return self.simulator.state.episodes.rod

    @property
    def scene(self) -> Scene:
        """The targets and cylinders."""
        return self.simulator.state.episodes.scene

    @property
    def applied_action(self) -> Tensor:
        """The sections' actions in the last step, ``(num_envs, n_agents, 2)`` float32; 0 after a reset."""
        return self.simulator.state.episodes.previous_action

    @property
    def tip_force(self) -> Tensor:
        """The force on the tip in the last step, N, ``(num_envs, 3)``."""
        return self.simulator.state.tip_force

    @property
    def body(self) -> Tensor:
        """The factors of the episodes' bodies in the order of ``FACTORS``, ``(num_envs, 6)``; no columns if nominal."""
        return self.simulator.state.episodes.body

    def contacts(self) -> Tensor:
        """Tell which nodes touch a cylinder, ``(num_envs, n_nodes)`` bool."""
        return self.simulator.contacts(self.simulator.state.episodes)

    # TorchRL's contract

    def _set_seed(self, seed: int | None) -> None:
        if seed is not None:
            self.simulator.seed(seed)

    def _reset(self, tensordict: TensorDictBase | None = None, seed: int | None = None, **kwargs) -> TensorDict:
        self._set_seed(seed)
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if mask is None:
            self.simulator.begin(self._stagger)
        else:
            self.simulator.begin_again(mask.reshape(-1))
        episodes = self.simulator.state.episodes
        return self._first_frame(episodes, self.simulator.sense(episodes))

    def maybe_reset(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Do what ``EnvBase.maybe_reset`` does, computing only the environments that are reset.

        Where asking whether there are any would mean to wait for the device, all of them are computed and masked.
        """
        done = tensordict.get(entries.DONE)
        if not sync.any_true(done):
            return tensordict
        mask = done.reshape(-1)
        rows, fresh, sight = self.simulator.begin_again(mask)
        first = self._first_frame(fresh, sight)
        if rows is None:
            _put(tensordict, _merged(mask, dict(_leaves(first)), tensordict))
        else:
            _put(tensordict, {key: tensordict.get(key).index_copy(0, rows, new) for key, new in _leaves(first)})
        return tensordict

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        episodes = self.simulator.state.episodes
        outcome = self.simulator.step(tensordict.get(entries.ACTION).clamp(-1.0, 1.0))
        verdict = outcome.verdict
        endings = (verdict.success, outcome.broken, verdict.contact_failure)
        return self._frame(episodes, outcome.sight, verdict.numbers, *endings, self._never)

    # frames

    def _first_frame(self, episodes: Episodes, sight: Sight) -> TensorDict:
        """Make the entries of a reset."""
        distance = (episodes.rod.position[..., -1] - episodes.scene.target).norm(dim=-1)
        zero, never = torch.zeros_like(distance), torch.zeros_like(episodes.terminated)
        numbers = {
            entries.DISTANCE: distance,
            entries.CONTACT_NODES: self.simulator.count_contacts(episodes),
            **dict.fromkeys((entries.TIP_STEP, entries.TORQUE_PER_AGENT, entries.TORQUE_JOINT), zero),
            **{(entries.REWARD_TERMS, name): zero for name in entries.REWARD_TERM_NAMES},
        }
        return self._frame(episodes, sight, numbers, never, never, never, torch.ones_like(never))

    def _frame(
        self,
        episodes: Episodes,
        sight: Sight,
        numbers: Mapping[NestedKey, Tensor],
        success: Tensor,
        broken: Tensor,
        contact_failure: Tensor | None,
        begins: Tensor,
    ) -> TensorDict:
        """Make everything that a step or a reset writes, in tensors of its own.

        ``numbers`` are ``(num_envs,)`` of any type and become float32 ``(num_envs, 1)``, unless they are that already.
        """
        columns = {key: value for key, value in numbers.items() if value.ndim == 2}
        numbers = {key: value for key, value in numbers.items() if value.ndim == 1}
        numbers |= {entries.DISCOVERED: sight.table.count, entries.DROPPED: sight.table.dropped}
        if self.simulator.curriculum:
            numbers[entries.DIFFICULTY] = episodes.difficulty
        numbers |= dict(zip(entries.BODY.values(), episodes.body.unbind(-1), strict=False))  # none if nominal
        position, at_agents = episodes.rod.position, self.simulator.at_agents
        own = (
            at_agents(position).to(torch.float32),
            at_agents(episodes.rod.velocity).to(torch.float32),
            episodes.previous_action.clone(),
        )
        if self.simulator.perturbation is not None:
            own = self.simulator.perturbation.observed(*own)
        done = episodes.terminated | episodes.truncated
        flags = torch.stack([success, broken, episodes.terminated, episodes.truncated, done, begins])
        success, broken, terminated, truncated, done, begins = flags.unsqueeze(-1).unbind(0)
        tip, target = torch.stack([position[..., -1], episodes.scene.target]).to(torch.float32).unbind(0)
        values: dict[NestedKey, Tensor] = {
            **dict(zip((entries.AGENT_POSITION, entries.AGENT_VELOCITY, entries.PREVIOUS_ACTION), own, strict=True)),
            entries.EDGE: sight.edge,
            entries.SLOT_DESCRIPTOR: sight.descriptor,
            entries.SLOT_ACTIVE: sight.active,
            entries.TIP: tip,
            entries.TARGET: target,
            entries.SUCCESS: success,
            entries.DIVERGED: broken,
            entries.TERMINATED: terminated,
            entries.TRUNCATED: truncated,
            entries.DONE: done,
            entries.IS_INIT: begins,
            **columns,
            **dict(zip(numbers, _columns(*numbers.values()), strict=True)),
        }
        if self._limited and contact_failure is not None:
            values[entries.CONTACT_FAILURE] = contact_failure.unsqueeze(-1)
        if self.sizes.n_privileged:
            values[entries.PRIVILEGED] = episodes.scene.privileged.to(torch.float32, copy=True)
        return entries.frame(values, episodes.batch_size, self.sizes, self.device)

    # checkpoints

    def generator_state(self) -> Tensor:
        """Give the state of the generator of scenes; in further rows those of a perturbation's and the bodies' own."""
        states = [generator.get_state() for generator in self.simulator.generators()]
        return states[0] if len(states) == 1 else torch.stack(states)

    def set_generator_state(self, state: Tensor) -> None:
        """Resume drawing from what ``generator_state`` returned."""
        for generator, own in zip(self.simulator.generators(), state.reshape(-1, state.shape[-1]), strict=True):
            generator.set_state(own.clone())  # a view's offset would not be heeded

    def simulation_state(self) -> TensorDict:
        """Give a copy of everything that changes."""
        return self.simulator.state.clone().to_tensordict()

    def load_simulation_state(self, state: TensorDictBase) -> None:
        """Continue from what ``simulation_state`` returned for as many environments of the same task."""
        self.simulator.load_state(state)

    # CUDA graphs, which repeat what they were recorded with on the same memory

    def in_place(self) -> AbstractContextManager[None]:
        """Steps and resets within change the simulation's tensors in place."""
        return self.simulator.in_place()

    def tensors(self) -> list[Tensor]:
        """Give the tensors that steps ``in_place`` change, each with memory of its own."""
        self.simulator.state = self.simulator.state.clone()
        return graphs.leaves(self.simulator.state)

    def generators(self) -> list[torch.Generator]:
        """Give the generators that steps draw from."""
        return self.simulator.generators()


def _leaves(td: TensorDictBase) -> list[tuple[NestedKey, Tensor]]:
    return list(td.items(include_nested=True, leaves_only=True))


def _put(into: TensorDictBase, values: Mapping[NestedKey, Tensor]) -> None:
    for key, value in values.items():
        into.set(key, value)


def _merged(mask: Tensor, new: Mapping[NestedKey, Tensor], old: TensorDictBase) -> dict[NestedKey, Tensor]:
    """Take rows in ``mask`` from ``new`` and the others from ``old``: one choice a type, not one an entry."""
    merged: dict[NestedKey, Tensor] = {}
    for dtype in dict.fromkeys(value.dtype for value in new.values()):
        names = [name for name, value in new.items() if value.dtype == dtype]
        ours, theirs = (torch.cat([side[name].flatten(1) for name in names], dim=1) for side in (new, old))
        widths = [new[name].shape[1:].numel() for name in names]
        parts = torch.where(mask.unsqueeze(-1), ours, theirs).split(widths, dim=1)
        merged |= {name: part.view(new[name].shape) for name, part in zip(names, parts, strict=True)}
    return merged


def _columns(*values: Tensor) -> tuple[Tensor, ...]:
    """Turn ``(num_envs,)`` of any numbers into ``(num_envs, 1)`` float32."""
    return torch.stack(values).to(torch.float32).unsqueeze(-1).unbind(0)
