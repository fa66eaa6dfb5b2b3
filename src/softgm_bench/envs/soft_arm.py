"""``SoftArmEnv``: N sections of one Cosserat-rod arm as cooperating agents, batched over environments."""

import torch
from tensordict import TensorClass, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from softgm_bench.envs import keys
from softgm_bench.envs.reward import reward_terms
from softgm_bench.envs.sensing import (
    Bins,
    SlotTable,
    bins_per_cylinder,
    cut_into_bins,
    discover,
    empty_table,
    observe_slots,
    sense,
)
from softgm_bench.envs.tasks import Scene, Task
from softgm_bench.rod.actuation import Actuation, control_points
from softgm_bench.rod.backend import Backend
from softgm_bench.rod.contact import contact_nodes, element_radius
from softgm_bench.rod.parameters import rod_constants
from softgm_bench.rod.state import RodState, dilatation, straight_rods

DIRECTIONS = 2  # normal and binormal


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
    """

    rod: RodState
    scene: Scene
    bins: Bins
    table: SlotTable
    previous_action: Tensor
    steps: Tensor
    terminated: Tensor
    truncated: Tensor


class SoftArmEnv(EnvBase):
    """A TorchRL environment with ``batch_size=(num_envs,)``; entries and shapes in ``softgm_bench.envs.keys``.

    One step is one control step of the rod. An environment that is done does not move until it is reset. Resets are
    partial (TorchRL's ``_reset`` mask) and draw scenes from the environment's own generator. A state that is not
    finite, or an element whose dilatation leaves the task's range, terminates that environment alone as ``diverged``;
    its last good state is what is observed.
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
        """
        super().__init__(device=torch.device(device), batch_size=torch.Size([num_envs]))
        config, parameters = task.config, backend.parameters
        self.task = task
        self.backend = backend
        self.horizon = config.horizon if horizon is None else horizon
        self.n_agents: int = config.n_agents
        self.n_slots: int = config.slots if task.max_cylinders else 0
        self.stagger = stagger
        self._dtype = dtype
        self._actuation = Actuation(
            parameters,
            config.n_agents,
            config.actuation.max_torque,
            config.actuation.basis,
            config.actuation.scaling,
            device=self.device,
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
        self._make_specs()
        self._simulation = self._fresh(num_envs)

    # TorchRL's contract

    def _make_specs(self) -> None:
        batch, n, m = self.batch_size[0], self.n_agents, self.n_slots

        def real(*shape: int) -> Unbounded:
            return Unbounded(shape=(batch, *shape), dtype=torch.float32, device=self.device)

        def flag(*shape: int) -> Binary:
            return Binary(shape=(batch, *shape), dtype=torch.bool, device=self.device)

        action = Bounded(-1.0, 1.0, shape=(batch, n, DIRECTIONS), dtype=torch.float32, device=self.device)
        agents = {
            "position": real(n, 3),
            "velocity": real(n, 3),
            "previous_action": action.clone(),
            "edge": flag(n, m),
        }
        slots = {"descriptor": real(m, 9), "active": flag(m)}
        info = {
            name: flag(1) if name in ("success", "diverged") else real(1)
            for _, name in (
                keys.SUCCESS,
                keys.DIVERGED,
                keys.DISTANCE,
                keys.TIP_STEP,
                keys.CONTACT_NODES,
                keys.DISCOVERED,
                keys.DROPPED,
                keys.TORQUE_PER_AGENT,
                keys.TORQUE_JOINT,
            )
        }
        terms = {name: real(1) for name in keys.REWARD_TERM_NAMES}
        self.observation_spec = Composite(
            agents=Composite(agents, shape=(batch, n), device=self.device),
            slots=Composite(slots, shape=(batch, m), device=self.device),
            tip=real(3),
            target=real(3),
            info=Composite(info, shape=(batch,), device=self.device),
            reward_terms=Composite(terms, shape=(batch,), device=self.device),
            shape=(batch,),
            device=self.device,
        )
        self.action_spec = Composite(
            agents=Composite(action=action, shape=(batch, n), device=self.device), shape=(batch,), device=self.device
        )
        self.reward_spec = real(1)
        self.done_spec = Composite(
            done=flag(1), terminated=flag(1), truncated=flag(1), shape=(batch,), device=self.device
        )

    def _set_seed(self, seed: int | None) -> None:
        if seed is not None:
            self._generator.manual_seed(seed)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs) -> TensorDict:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if mask is None:
            self._simulation = self._fresh(self.batch_size[0])
            if self.stagger:
                self._simulation.steps.random_(0, self.horizon, generator=self._generator)
        else:
            chosen = mask.reshape(-1).nonzero().squeeze(-1)
            if len(chosen):
                self._simulation[chosen] = self._fresh(len(chosen))
        simulation = self._simulation
        zero = torch.zeros(self.batch_size, dtype=self._dtype, device=self.device)
        info = dict.fromkeys(("tip_step", "torque_per_agent", "torque_joint"), zero)
        never = torch.zeros_like(simulation.terminated)
        observation = self._observe(simulation, self._sense(simulation))
        observation["info"] = self._info(simulation, success=never, diverged=never, **info)
        observation["reward_terms"] = {name: _column(zero) for name in keys.REWARD_TERM_NAMES}
        observation.update(_done_flags(simulation))
        return self._tensordict(observation)

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        before = self._simulation
        config = self.task.config
        action = tensordict.get(keys.ACTION).clamp(-1.0, 1.0)
        active = ~(before.terminated | before.truncated)
        rod = self.backend.control_step(
            before.rod,
            self._actuation.couple(action, self._dtype),
            cylinders=before.scene.cylinders if self.task.max_cylinders else None,
            active=active,
        )
        diverged = self._diverged(rod, config.min_dilatation, config.max_dilatation)
        if bool(diverged.any()):
            rod[diverged] = before.rod[diverged]
        now = before.replace(rod=rod, steps=before.steps + active, previous_action=action.clone())
        sensed = self._sense(now)
        now.table, new_bins = discover(before.table, sensed)

        distance = _distance(now)
        success = (distance < config.success_radius) & ~diverged
        now.terminated = before.terminated | (active & (success | diverged))
        now.truncated = before.truncated | (active & (now.steps >= self.horizon) & ~now.terminated)
        info = self._info(
            now,
            success=success,
            diverged=diverged,
            tip_step=(now.rod.position[..., -1] - before.rod.position[..., -1]).norm(dim=-1),
            **self._torques(action),
        )
        terms = reward_terms(
            config.reward,
            distance=distance,
            previous_distance=_distance(before),
            action=action,
            previous_action=before.previous_action,
            contact_nodes=info["contact_nodes"].squeeze(-1),
            new_bins=new_bins,
            success=success,
        )
        self._simulation = now
        out = self._observe(now, sensed)
        out["info"] = info
        out["reward_terms"] = {name: _column(value) for name, value in terms.items()}
        out["reward"] = _column(sum(terms.values(), torch.zeros_like(distance)))
        out.update(_done_flags(now))
        return self._tensordict(out)

    # the parts of a step

    def _fresh(self, count: int) -> Simulation:
        """Episodes at their beginning, scenes drawn from the own generator."""
        config = self.task.config
        scene = self.task.sample(count, self._generator).apply(self._real)
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
            batch_size=[count],
        )
        simulation.table, _ = discover(simulation.table, self._sense(simulation))
        return simulation

    def _real(self, value: Tensor) -> Tensor:
        return value.to(self._dtype) if value.is_floating_point() else value

    def _agents(self, of_nodes: Tensor) -> Tensor:
        """``(num_envs, 3, n_nodes)`` to the agents' nodes, ``(num_envs, n_agents, 3)``."""
        return of_nodes.index_select(-1, self._agent_node).transpose(-1, -2)

    def _sense(self, simulation: Simulation) -> Tensor:
        return sense(self._agents(simulation.rod.position), simulation.bins, self.task.config.sensing_radius)

    def _observe(self, simulation: Simulation, sensed: Tensor) -> dict:
        descriptor, active, edge = observe_slots(simulation.table, simulation.bins, sensed)
        return {
            "agents": {
                "position": _float32(self._agents(simulation.rod.position)),
                "velocity": _float32(self._agents(simulation.rod.velocity)),
                "previous_action": simulation.previous_action.clone(),
                "edge": edge,
            },
            "slots": {"descriptor": _float32(descriptor), "active": active},
            "tip": _float32(simulation.rod.position[..., -1]),
            "target": _float32(simulation.scene.target),
        }

    def _info(self, simulation: Simulation, **values: Tensor) -> dict[str, Tensor]:
        """Entries under ``info``, ``(num_envs, 1)``."""
        position = simulation.rod.position
        if self.task.max_cylinders:
            radius = element_radius(position, self._volume)
            touching = contact_nodes(position, radius, simulation.scene.cylinders).sum(dim=-1)
        else:
            touching = torch.zeros_like(simulation.steps)
        values = {
            "distance": _distance(simulation),
            "contact_nodes": touching,
            "discovered": simulation.table.count,
            "dropped": simulation.table.dropped,
            **values,
        }
        return {name: _column(value) for name, value in values.items()}

    def _torques(self, action: Tensor) -> dict[str, Tensor]:
        """The paper's formula (mean of the agents' norms) and the scale of its table (norm over all), N m."""
        torque = self.task.config.actuation.max_torque * action
        return {
            "torque_per_agent": torque.norm(dim=-1).mean(dim=-1),
            "torque_joint": torque.flatten(1).norm(dim=-1),
        }

    def _diverged(self, rod: RodState, low: float, high: float) -> Tensor:
        stretch = dilatation(rod.position, self._rest_length)
        good = ((stretch >= low) & (stretch <= high)).all(dim=-1)  # false for NaN
        for rates in (rod.velocity, rod.omega, rod.director):
            good &= rates.isfinite().flatten(1).all(dim=-1)
        return ~good

    def _tensordict(self, entries: dict) -> TensorDict:
        batch, n, m = self.batch_size[0], self.n_agents, self.n_slots
        out = TensorDict(entries, batch_size=self.batch_size, device=self.device)
        out["agents"].batch_size = [batch, n]
        out["slots"].batch_size = [batch, m]
        return out

    # what checkpoints need

    def generator_state(self) -> Tensor:
        """State of the generator that scenes are drawn from."""
        return self._generator.get_state()

    def set_generator_state(self, state: Tensor) -> None:
        """Go on drawing from what ``generator_state`` returned."""
        self._generator.set_state(state)

    def simulation_state(self) -> TensorDict:
        """A copy of all episodes as they stand."""
        return self._simulation.clone().to_tensordict()

    def load_simulation_state(self, state: TensorDictBase) -> None:
        """Go on from what ``simulation_state`` returned for as many environments of the same task."""
        self._simulation.update_(state)


def _distance(simulation: Simulation) -> Tensor:
    """Tip to target, m, ``(num_envs,)``."""
    return (simulation.rod.position[..., -1] - simulation.scene.target).norm(dim=-1)


def _column(value: Tensor) -> Tensor:
    """``(num_envs,)`` to ``(num_envs, 1)``, flags as bool and numbers as float32."""
    value = value.unsqueeze(-1)
    return value if value.dtype == torch.bool else value.to(torch.float32)


def _float32(value: Tensor) -> Tensor:
    return value.to(torch.float32, copy=True)


def _done_flags(simulation: Simulation) -> dict[str, Tensor]:
    terminated, truncated = simulation.terminated.unsqueeze(-1), simulation.truncated.unsqueeze(-1)
    return {"terminated": terminated.clone(), "truncated": truncated.clone(), "done": terminated | truncated}
