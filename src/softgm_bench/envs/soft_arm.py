"""``SoftArmEnv``: N sections of one Cosserat-rod arm as cooperating agents, batched over environments."""

from collections.abc import Callable, Mapping

import torch
from tensordict import TensorClass, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Unbounded
from torchrl.envs import EnvBase

from softgm_bench.envs import keys
from softgm_bench.envs.curriculum import Progress, difficulty, first_progress, note_ends
from softgm_bench.envs.perturbation import Perturbation, PerturbationConfig
from softgm_bench.envs.reward import reward_terms
from softgm_bench.envs.sensing import Bins, Sight, SlotTable, bins_per_cylinder, cut_into_bins, empty_table, look
from softgm_bench.envs.specs import DIRECTIONS, make_specs
from softgm_bench.envs.tasks import Scene, Task
from softgm_bench.rod.actuation import Actuation, control_points
from softgm_bench.rod.backend import Backend
from softgm_bench.rod.contact_nodes import contact_nodes
from softgm_bench.rod.dense import dense
from softgm_bench.rod.divergence import diverged
from softgm_bench.rod.parameters import rod_constants
from softgm_bench.rod.state import RodState, straight_rods

Key = str | tuple[str, str]


class Simulation(TensorClass):
    """Everything that an episode consists of; ``batch_size`` is ``(num_envs,)``.

    Attributes:
        rod: state of the arm.
        scene: target and cylinders.
        bins: the cylinders cut into bins.
        table: discovered bins.
        previous_action: ``(num_envs, n_agents, 2)`` float32.
        steps: control steps since the reset, ``(num_envs,)`` int64.
        terminated: success or divergence, ``(num_envs,)`` bool.
        truncated: the horizon, ``(num_envs,)`` bool.
        difficulty: of the scene, from 0 to 1, the task's own, ``(num_envs,)`` float32.
    """

    rod: RodState
    scene: Scene
    bins: Bins
    table: SlotTable
    previous_action: Tensor
    steps: Tensor
    terminated: Tensor
    truncated: Tensor
    difficulty: Tensor


class SoftArmEnv(EnvBase):
    """A TorchRL environment with ``batch_size=(num_envs,)``; entries and shapes in ``softgm_bench.envs.keys``.

    One step is one control step of the rod. An environment that is done does not move until it is reset. Resets are
    partial (TorchRL's ``_reset`` mask) and draw scenes from the environment's own generator. A state that is not
    finite, or an element whose dilatation leaves the task's range, terminates that environment alone as ``diverged``;
    its last good state is what is observed.

    On a device other than the CPU nothing here waits for the device: see ``softgm_bench.rod.dense``.
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
            stagger: a full reset starts the episodes' clocks at random steps, so that their truncations do not fall
                together and every batch of training holds all phases of an episode.
            perturbation: of observations, sections and tip, none by default.

        Raises:
            ValueError: the perturbation is of a section that does not exist.
        """
        super().__init__(device=torch.device(device), batch_size=torch.Size([num_envs]))
        config, parameters = task.config, backend.parameters
        self.task = task
        self.backend = backend
        self.horizon = config.horizon if horizon is None else horizon
        self.n_agents: int = config.n_agents
        self.n_slots: int = config.slots if task.max_cylinders else 0
        self.n_privileged: int = task.n_privileged
        self.stagger = stagger
        self._dtype = dtype
        self._actuation = Actuation(
            parameters,
            config.n_agents,
            config.actuation.max_torque,
            config.actuation.basis,
            config.actuation.scaling,
            device=self.device,
            dtype=dtype,
        )
        arc_length = control_points(config.n_agents, parameters.base_length)
        nodes = torch.as_tensor(arc_length) * (parameters.n_elements / parameters.base_length)
        self._agent_node = nodes.round().long().to(self.device)
        constants = rod_constants(parameters)
        self._rest_length = torch.as_tensor(constants.rest_length, dtype=dtype, device=self.device)
        self._volume = torch.as_tensor(constants.volume, dtype=dtype, device=self.device)
        n_bins = bins_per_cylinder(task.max_cylinder_length, config.bin_length)
        self._n_bins = task.max_cylinders * n_bins
        self._generator = torch.Generator(device=self.device)
        self._generator.manual_seed(seed)
        curriculum = config.curriculum.enabled
        specs = make_specs(num_envs, self.n_agents, self.n_slots, self.n_privileged, curriculum, self.device)
        self._perturbation: Perturbation | None = None
        if perturbation is not None and not perturbation.nothing:
            own = Perturbation(perturbation, num_envs, self.n_agents, seed, self.device, dtype)
            self._perturbation, spec = own, specs["observation_spec"]
            bounded = spec[keys.PREVIOUS_ACTION]
            spec[keys.PREVIOUS_ACTION] = Unbounded(shape=bounded.shape, dtype=bounded.dtype, device=self.device)
        self._tip_force: Tensor | None = None
        for name, spec in specs.items():
            setattr(self, name, spec)
        self._progress: Progress | None = first_progress(num_envs, self.device) if curriculum else None
        self._simulation, _ = self._fresh(num_envs)

    # what simulates, as it is: for those who record or draw it; none of it is a copy

    @property
    def rod(self) -> RodState:
        """The arms."""
        return self._simulation.rod

    @property
    def scene(self) -> Scene:
        """Targets and cylinders."""
        return self._simulation.scene

    @property
    def applied_action(self) -> Tensor:
        """What the sections did in the last step, ``(num_envs, n_agents, 2)`` float32; 0 after a reset."""
        return self._simulation.previous_action

    @property
    def tip_force(self) -> Tensor | None:
        """Force on the tip in the last step, N, ``(num_envs, 3)``; None if no perturbation pushes."""
        return self._tip_force

    def contacts(self) -> Tensor:
        """Which nodes touch a cylinder, ``(num_envs, n_nodes)`` bool."""
        return contact_nodes(self.rod.position, self._volume, self.scene.cylinders)

    # TorchRL's contract

    def _set_seed(self, seed: int | None) -> None:
        if seed is not None:
            self._generator.manual_seed(seed)
            if self._perturbation is not None:
                self._perturbation.seed(seed)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs) -> TensorDict:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if mask is None:
            self._simulation, _ = self._fresh(self.batch_size[0])
            if self.stagger:
                self._simulation.steps.random_(0, self.horizon, generator=self._generator)
            if self._progress is not None:
                self._progress.counting.fill_(not self.stagger)  # what is cut short says nothing about its scene
            if self._perturbation is not None:
                self._perturbation.begin()
        else:
            self._begin_again(mask.reshape(-1))
        return self._first_frame(self._simulation, self._look(self._simulation))

    def maybe_reset(self, tensordict: TensorDictBase) -> TensorDictBase:
        """What ``EnvBase.maybe_reset`` does, computing only the environments that are reset.

        Where asking whether there are any would mean to wait for the device, all of them are computed and masked.
        """
        done = tensordict.get(keys.DONE)
        if not dense(self.device) and not bool(done.any()):
            return tensordict
        mask = done.reshape(-1)
        rows, fresh, sight = self._begin_again(mask)

        def merged(old: Tensor, new: Tensor) -> Tensor:
            if rows is None:
                return torch.where(mask.view(-1, *(1,) * (old.ndim - 1)), new, old)
            return old.index_copy(0, rows, new)

        _put(self._first_frame(fresh, sight), tensordict, merged)
        return tensordict

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        simulation, config = self._simulation, self.task.config
        rod, scene, previous_action = simulation.rod, simulation.scene, simulation.previous_action
        terminated, truncated = simulation.terminated, simulation.truncated
        action = tensordict.get(keys.ACTION).clamp(-1.0, 1.0)
        active = ~(terminated | truncated)
        push = None
        if self._perturbation is not None:
            action = self._perturbation.applied(action)
            self._tip_force = self._perturbation.tip_force(simulation.steps, active)
            push = None if self._tip_force is None else self._on_tip(self._tip_force)
        moved = self.backend.control_step(
            rod,
            self._actuation.couple(action),
            force=push,
            cylinders=scene.cylinders if self.task.max_cylinders else None,
            active=active,
        )
        broken = diverged(moved, self._rest_length, config.min_dilatation, config.max_dilatation)
        if dense(self.device) or bool(broken.any()):
            moved = rod.where(broken, moved)
        simulation.rod, simulation.previous_action = moved, action
        simulation.steps = steps = simulation.steps + active
        sight = self._look(simulation)
        simulation.table = sight.table

        tip, previous_tip, target = moved.position[..., -1], rod.position[..., -1], scene.target
        distance = (tip - target).norm(dim=-1)
        success = (distance < config.success_radius) & ~broken
        simulation.terminated = terminated = terminated | (active & (success | broken))
        simulation.truncated = truncated | (active & (steps >= self.horizon) & ~terminated)
        if self._progress is not None:
            ended = active & (terminated | simulation.truncated)
            self._progress = note_ends(self._progress, ended, success, config.curriculum)
        touching = self._count_contacts(simulation)
        terms = reward_terms(
            config.reward,
            distance=distance,
            previous_distance=(previous_tip - target).norm(dim=-1),
            action=action,
            previous_action=previous_action,
            contact_nodes=touching,
            new_bins=sight.new,
            success=success,
        )
        tip_step = (tip - previous_tip).norm(dim=-1)
        numbers = self._numbers(sight, distance, touching, tip_step, *self._torques(action))
        numbers |= {(keys.REWARD_TERMS, name): value for name, value in terms.items()}
        numbers[keys.REWARD] = sum(terms.values(), torch.zeros_like(distance))
        return self._frame(simulation, sight, numbers, success, broken)

    # the parts of a step

    def _fresh(self, count: int) -> tuple[Simulation, Sight]:
        """Episodes at their beginning, scenes drawn from the own generator, and what is seen there."""
        config = self.task.config
        level = None if self._progress is None else difficulty(self._progress, config.curriculum)
        scene = self.task.sample(count, self._generator, level).apply(self._real)
        bins = cut_into_bins(scene.cylinders, config.bin_length, self.task.max_cylinder_length)
        never = torch.zeros(count, dtype=torch.bool, device=self.device)
        simulation = Simulation(
            rod=straight_rods(self.backend.parameters, count, self._dtype, self.device),
            scene=scene,
            bins=bins,
            table=empty_table(count, self.n_slots, self._n_bins, self.device),
            previous_action=torch.zeros((count, self.n_agents, DIRECTIONS), device=self.device),
            steps=torch.zeros(count, dtype=torch.int64, device=self.device),
            terminated=never,
            truncated=never.clone(),
            difficulty=torch.ones(count, device=self.device) * (1.0 if level is None else level),
            batch_size=[count],
        )
        sight = self._look(simulation)
        simulation.table = sight.table
        return simulation, sight

    def _begin_again(self, mask: Tensor) -> tuple[Tensor | None, Simulation, Sight]:
        """Replace the episodes in ``mask``, ``(num_envs,)``, by new ones.

        Returns:
            The replaced rows, and new episodes for these; on a device that must not be waited for, None, and new
            episodes for all rows, of which those in ``mask`` are used.
        """
        if self._progress is not None:
            self._progress.counting.logical_or_(mask)
        if self._perturbation is not None:
            self._perturbation.begin(mask)
        if dense(self.device):
            fresh, sight = self._fresh(len(mask))
            self._simulation = fresh.where(mask, self._simulation)
            return None, fresh, sight
        rows = mask.nonzero().squeeze(-1)
        fresh, sight = self._fresh(len(rows))
        self._simulation[rows] = fresh
        return rows, fresh, sight

    def _real(self, value: Tensor) -> Tensor:
        return value.to(self._dtype) if value.is_floating_point() else value

    def _agents(self, of_nodes: Tensor) -> Tensor:
        """``(num_envs, 3, n_nodes)`` to the agents' nodes, ``(num_envs, n_agents, 3)``."""
        return of_nodes.index_select(-1, self._agent_node).transpose(-1, -2)

    def _on_tip(self, force: Tensor) -> Tensor:
        """``(num_envs, 3)`` to a force on every node, ``(num_envs, 3, n_nodes)``."""
        return torch.nn.functional.pad(force.unsqueeze(-1), (self.backend.parameters.n_elements, 0))

    def _look(self, simulation: Simulation) -> Sight:
        config = self.task.config
        return look(
            self._agents(simulation.rod.position),
            simulation.scene.cylinders,
            simulation.bins,
            simulation.table,
            config.sensing_radius,
            config.bin_length,
        )

    def _count_contacts(self, simulation: Simulation) -> Tensor:
        """C_t, ``(num_envs,)`` int64."""
        if not self.task.max_cylinders:
            return torch.zeros_like(simulation.steps)
        return contact_nodes(simulation.rod.position, self._volume, simulation.scene.cylinders).sum(dim=-1)

    def _torques(self, action: Tensor) -> tuple[Tensor, Tensor]:
        """The paper's formula (mean of the agents' norms) and the scale of its table (norm over all), N m."""
        torque = self.task.config.actuation.max_torque * action
        return torque.norm(dim=-1).mean(dim=-1), torque.flatten(1).norm(dim=-1)

    # what is written to tensordicts

    def _first_frame(self, simulation: Simulation, sight: Sight) -> TensorDict:
        """Entries of a reset."""
        rod = simulation.rod
        distance = (rod.position[..., -1] - simulation.scene.target).norm(dim=-1)
        zero, never = torch.zeros_like(distance), torch.zeros_like(simulation.terminated)
        numbers = self._numbers(sight, distance, self._count_contacts(simulation), zero, zero, zero)
        numbers |= {(keys.REWARD_TERMS, name): zero for name in keys.REWARD_TERM_NAMES}
        return self._frame(simulation, sight, numbers, never, never.clone())

    def _numbers(
        self,
        sight: Sight,
        distance: Tensor,
        touching: Tensor,
        tip_step: Tensor,
        torque_per_agent: Tensor,
        torque_joint: Tensor,
    ) -> dict[Key, Tensor]:
        """Numbers under ``info`` by key, ``(num_envs,)`` each."""
        return {
            keys.DISTANCE: distance,
            keys.TIP_STEP: tip_step,
            keys.CONTACT_NODES: touching,
            keys.DISCOVERED: sight.table.count,
            keys.DROPPED: sight.table.dropped,
            keys.TORQUE_PER_AGENT: torque_per_agent,
            keys.TORQUE_JOINT: torque_joint,
        }

    def _frame(
        self, simulation: Simulation, sight: Sight, numbers: Mapping[Key, Tensor], success: Tensor, broken: Tensor
    ) -> TensorDict:
        """Everything that a step or a reset writes, in tensors of its own."""
        if self._progress is not None:
            numbers = {**numbers, keys.DIFFICULTY: simulation.difficulty}
        rod = simulation.rod
        terminated, truncated = simulation.terminated.unsqueeze(-1), simulation.truncated.unsqueeze(-1)
        position = rod.position
        observed = (
            _float32(self._agents(position)),
            _float32(self._agents(rod.velocity)),
            simulation.previous_action.clone(),
        )
        if self._perturbation is not None:
            observed = self._perturbation.observed(*observed)
        entries: dict[str, dict[str, Tensor]] = {
            "agents": {
                **dict(zip(("position", "velocity", "previous_action"), observed, strict=True)),
                "edge": sight.edge,
            },
            "slots": {"descriptor": sight.descriptor, "active": sight.active},
            "info": {"success": success.unsqueeze(-1), "diverged": broken.unsqueeze(-1)},
            keys.REWARD_TERMS: {},
        }
        root = {
            "tip": _float32(position[..., -1]),
            "target": _float32(simulation.scene.target),
            "terminated": terminated.clone(),
            "truncated": truncated.clone(),
            "done": terminated | truncated,
        }
        if self.n_privileged:
            root[keys.PRIVILEGED] = _float32(simulation.scene.privileged)
        for key, column in zip(numbers, _columns(*numbers.values()), strict=True):
            (root if isinstance(key, str) else entries[key[0]])[key if isinstance(key, str) else key[1]] = column
        batch = list(simulation.batch_size)
        sizes = {"agents": [*batch, self.n_agents], "slots": [*batch, self.n_slots]}
        groups = {
            name: TensorDict(group, sizes.get(name, batch), device=self.device) for name, group in entries.items()
        }
        return TensorDict(groups | root, batch, device=self.device)

    # what checkpoints need

    def generator_state(self) -> Tensor:
        """State of the generator that scenes are drawn from; with a perturbation, its own in a second row."""
        states = [generator.get_state() for generator in self._generators()]
        return states[0] if len(states) == 1 else torch.stack(states)

    def set_generator_state(self, state: Tensor) -> None:
        """Go on drawing from what ``generator_state`` returned."""
        for generator, own in zip(self._generators(), state.reshape(-1, state.shape[-1]), strict=True):
            generator.set_state(own.clone())  # a view's offset would not be heeded

    def _generators(self) -> list[torch.Generator]:
        return [self._generator, *([] if self._perturbation is None else [self._perturbation.generator])]

    def simulation_state(self) -> TensorDict:
        """A copy of all episodes as they stand and, if there are any, of the curriculum and the pushes' directions."""
        state = self._simulation.clone().to_tensordict()
        if self._progress is not None:
            state["curriculum"] = self._progress.clone().to_tensordict()
        if self._perturbation is not None:
            state["push"] = self._perturbation.direction.clone()
        return state

    def load_simulation_state(self, state: TensorDictBase) -> None:
        """Go on from what ``simulation_state`` returned for as many environments of the same task."""
        self._simulation.update_(state.exclude("curriculum", "push"))
        if self._progress is not None:
            self._progress.update_(state["curriculum"])
        if self._perturbation is not None:
            self._perturbation.direction = state["push"].clone()


def _put(new: TensorDictBase, into: TensorDictBase, merged: Callable[[Tensor, Tensor], Tensor]) -> None:
    """Replace every entry of ``into`` that is in ``new`` by ``merged(old, new)``."""
    for name, value in new.items():
        if isinstance(value, TensorDictBase):
            _put(value, into.get(name), merged)
        else:
            into.set(name, merged(into.get(name), value))


def _columns(*values: Tensor) -> tuple[Tensor, ...]:
    """``(num_envs,)`` of any numbers to ``(num_envs, 1)`` float32."""
    return torch.stack(values).to(torch.float32).unsqueeze(-1).unbind(0)


def _float32(value: Tensor) -> Tensor:
    return value.to(torch.float32, copy=True)
