"""The arm's simulation: its whole mutable state, and the control step that moves it.

``Simulation`` holds everything that changes, so that a checkpoint is a copy of it (and of the generators).
``Simulator`` moves it; ``soft_arm`` turns it into TorchRL's environment. On a device other than the CPU nothing here
waits for the device: see ``softgm_bench.rod.sync``.
"""

import copy
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np
import torch
from tensordict import TensorClass, TensorDictBase
from torch import Tensor

from softgm_bench.envs import entries
from softgm_bench.envs.curriculum import (
    Progress,
    difficulty,
    first_progress,
    further_contact,
    leading,
    note_ends,
    scene_difficulty,
    waived_cost,
)
from softgm_bench.envs.perturbation import Perturbation, PerturbationConfig
from softgm_bench.envs.sensing import Bins, Sight, SlotTable, bins_per_cylinder, cut_into_bins, empty_table, look
from softgm_bench.envs.tasks.base import Scene, Task
from softgm_bench.envs.verdict import Step, Verdict, judge
from softgm_bench.rod import sync
from softgm_bench.rod.actuation import DIRECTIONS, Actuation, control_points
from softgm_bench.rod.backend import Backend
from softgm_bench.rod.bodies import Bodies, draw, scales
from softgm_bench.rod.contact_nodes import contact_nodes
from softgm_bench.rod.divergence import diverged
from softgm_bench.rod.parameters import rod_constants
from softgm_bench.rod.randomise import FACTORS, RandomiseConfig
from softgm_bench.rod.state import RodState, straight_rods
from softgm_bench.upstream import graphs


class Episodes(TensorClass):
    """The episodes under way, replaced one by one as they end; ``batch_size`` is ``(num_envs,)``.

    Attributes:
        rod: state of the arm.
        scene: target and cylinders.
        bins: the cylinders cut into bins.
        table: discovered bins.
        shown: descriptors of the slots' bins as they were last sensed, ``(num_envs, n_slots, 9)`` float32; without
            slots where nothing moves.
        previous_action: as the sections applied it, ``(num_envs, n_agents, 2)`` float32; 0 after a reset.
        steps: control steps since the reset, ``(num_envs,)`` int64.
        contact_steps: those of them that were in contact, where the task limits them, ``(num_envs,)`` int64; counted
            from below 0 where an easier scene allows more.
        terminated: success, divergence or too much contact, ``(num_envs,)`` bool.
        truncated: the horizon, ``(num_envs,)`` bool.
        difficulty: of the scene, from 0 to 1, the task's own, ``(num_envs,)`` float32.
        body: factors on the arm's parameters in the order of ``FACTORS``, ``(num_envs, 6)`` float64; no columns where
            all arms are the nominal one.
    """

    rod: RodState
    scene: Scene
    bins: Bins
    table: SlotTable
    shown: Tensor
    previous_action: Tensor
    steps: Tensor
    contact_steps: Tensor
    terminated: Tensor
    truncated: Tensor
    difficulty: Tensor
    body: Tensor


class Simulation(TensorClass):
    """Everything of the environments that changes; ``batch_size`` is ``(num_envs,)``.

    Attributes:
        episodes: under way.
        progress: where the curriculum stands.
        push: direction of the disturbance on the tip in the episodes under way, ``(num_envs, 3)``.
        tip_force: force on the tip in the last control step, N, ``(num_envs, 3)``.
    """

    episodes: Episodes
    progress: Progress
    push: Tensor
    tip_force: Tensor


class Outcome(NamedTuple):
    """One control step of every environment, beside the state that it led to.

    Attributes:
        sight: what the agents sense after the step.
        broken: whether the simulation broke, ``(num_envs,)`` bool.
        verdict: on the step.
    """

    sight: Sight
    broken: Tensor
    verdict: Verdict


class Beginning(NamedTuple):
    """What all episodes have in common as they begin, of some number of environments; shapes as in ``Episodes``."""

    rod: RodState
    table: SlotTable
    shown: Tensor
    previous_action: Tensor
    never: Tensor
    whole: Tensor
    body: Tensor


class Simulator:
    """Moves ``num_envs`` arms.

    Attributes:
        state: everything that changes, but for the generators.
        task: what is drawn.
        backend: the rod's implementation.
        perturbation: what goes wrong; None: nothing.
        randomise: from which ranges bodies are drawn; None: all arms are the nominal one.
        n_slots: obstacle slots, M.
        curriculum: whether scenes follow the task's curriculum.
    """

    def __init__(
        self,
        task: Task,
        backend: Backend,
        num_envs: int,
        seed: int,
        horizon: int,
        device: torch.device,
        dtype: torch.dtype,
        perturbation: PerturbationConfig | None,
        randomise: RandomiseConfig | None = None,
    ) -> None:
        """Draw the first episodes; arguments as in ``SoftArmEnv``.

        Raises:
            ValueError: the perturbation is of a section that does not exist.
        """
        config, parameters = task.config, backend.parameters
        self.task, self.backend, self.horizon = task, backend, horizon
        self.device, self.dtype = device, dtype
        self.n_slots: int = config.slots if task.max_cylinders else 0
        self.curriculum: bool = config.curriculum.enabled
        actuation = config.actuation
        sections = (config.n_agents, actuation.max_torque, actuation.basis, actuation.scaling)
        self._actuation = Actuation(parameters, *sections, device=device, dtype=dtype)
        arc_length = control_points(config.n_agents, parameters.base_length)
        nodes = torch.as_tensor(arc_length) * (parameters.n_elements / parameters.base_length)
        self._agent_node = nodes.round().long().to(device)
        constants = rod_constants(parameters)
        self._rest_length = torch.as_tensor(constants.rest_length, dtype=dtype, device=device)
        self._volume = torch.as_tensor(constants.volume, dtype=dtype, device=device)
        self._n_bins = task.max_cylinders * bins_per_cylinder(task.max_cylinder_length, config.bin_length)
        self._counts_pushes = config.max_contact_steps is not None and config.contact_counts == "within"
        self._unpushed = torch.zeros(num_envs, dtype=torch.bool, device=device)
        self._generator = torch.Generator(device=device)
        self.randomise = None if randomise is None or randomise.nothing else randomise
        self._body_generator = torch.Generator(device=device)
        self._seed_scenes(seed)
        self.perturbation: Perturbation | None = None
        if perturbation is not None and not perturbation.nothing:
            self.perturbation = Perturbation(perturbation, config.n_agents, seed, device)
        self._beginnings: dict[int, Beginning] = {}
        progress = first_progress(num_envs, device)
        nothing = torch.zeros((num_envs, 3), dtype=dtype, device=device)
        fresh, _ = self.fresh(progress)
        self.state = Simulation(
            episodes=fresh.clone(), progress=progress, push=nothing, tip_force=nothing.clone(), batch_size=[num_envs]
        )

    def __deepcopy__(self, memo: dict[int, object]) -> "Simulator":
        """A simulator that moves on its own; what never changes is shared.

        Without this a copy would move the same arms: a tensorclass gives itself in place of a copy.
        """
        other = copy.copy(self)
        other.state = self.state.clone()
        other._generator = copy.deepcopy(self._generator, memo)
        other._body_generator = copy.deepcopy(self._body_generator, memo)
        other.perturbation = copy.deepcopy(self.perturbation, memo)
        return other

    # generators

    def seed(self, seed: int) -> None:
        """Begin the random streams that belong to a seed: of scenes, of bodies, and of what goes wrong."""
        self._seed_scenes(seed)
        if self.perturbation is not None:
            self.perturbation.seed(seed)

    def _seed_scenes(self, seed: int) -> None:
        """Bodies have a stream of their own: scenes are the same with and without them."""
        self._generator.manual_seed(seed)
        self._body_generator.manual_seed(int(np.random.SeedSequence(seed, spawn_key=(4,)).generate_state(1)[0]))

    def generators(self) -> list[torch.Generator]:
        """Give the generator of scenes and those of a perturbation and of bodies, where there are any."""
        more = [] if self.perturbation is None else [self.perturbation.generator]
        return [self._generator, *more, *([] if self.randomise is None else [self._body_generator])]

    def load_state(self, state: TensorDictBase) -> None:
        """Take over a copy of ``state`` of as many environments of the same task."""
        if "episodes" in state:
            self.state.update_(state)
            return
        # a checkpoint of before the curriculum and the push belonged to the simulation
        self.state.episodes.update_(state.exclude("curriculum", "push"))
        if "curriculum" in state:
            self.state.progress.update_(state["curriculum"])
        if "push" in state:
            self.state.push.copy_(state["push"])

    # memory

    @contextmanager
    def in_place(self) -> Iterator[None]:
        """Write what is done within into the tensors that the state has now, instead of replacing them."""
        held = self.state.copy()
        try:
            yield
            graphs.copy_into(graphs.leaves(held), graphs.leaves(self.state))
        finally:
            self.state = held

    # episodes begin

    def begin(self, stagger: bool) -> None:
        """Begin a new episode in every environment; ``stagger`` starts the clocks at random steps."""
        state = self.state
        state.episodes = self.fresh(state.progress)[0].clone()
        if stagger:
            state.episodes.steps.random_(0, self.horizon, generator=self._generator)
        state.progress.counting.fill_(not stagger)  # what is cut short says nothing about its scene
        self._push_anew(None)

    def begin_again(self, mask: Tensor) -> tuple[Tensor | None, Episodes, Sight]:
        """Replace the episodes in ``mask``, ``(num_envs,)``, by new ones.

        Returns:
            The replaced rows, and new episodes for these; on a device that must not be waited for, None, and new
            episodes for all rows, of which those in ``mask`` are used.
        """
        state = self.state
        state.progress.counting.logical_or_(mask)
        self._push_anew(mask)
        if not sync.is_free(self.device):
            fresh, sight = self.fresh(state.progress)
            state.episodes = fresh.where(mask, state.episodes)
            return None, fresh, sight
        rows = mask.nonzero().squeeze(-1)
        fresh, sight = self.fresh(state.progress, rows)
        state.episodes[rows] = fresh
        return rows, fresh, sight

    def fresh(self, progress: Progress, rows: Tensor | None = None) -> tuple[Episodes, Sight]:
        """Make episodes at their beginning, scenes drawn from the own generator, and what is sensed there.

        For the environments ``rows``, ``(count,)``, or without them for all of ``progress``.
        Not to be changed in place: what does not depend on the scene is shared with other beginnings.
        """
        count = len(progress.stage if rows is None else rows)
        blank = self._blank(count)
        drawn, level = self._draw(count, progress, rows)
        scene = drawn.apply(self._real)
        bins = self._cut(scene)
        body = blank.body if self.randomise is None else draw(self.randomise, count, self._body_generator)
        further = None if level is None else further_contact(level, self.task.config)
        episodes = Episodes(
            rod=blank.rod,
            scene=scene,
            bins=bins,
            table=blank.table,
            shown=blank.shown,
            previous_action=blank.previous_action,
            steps=blank.table.count,
            contact_steps=blank.table.count if further is None else -further,
            terminated=blank.never,
            truncated=blank.never,
            difficulty=blank.whole if level is None else level.to(torch.float32),
            body=body,
            batch_size=[count],
        )
        sight = self.sense(episodes)
        self._note(episodes, sight)
        return episodes, sight

    def _draw(self, count: int, progress: Progress, rows: Tensor | None) -> tuple[Scene, Tensor | None]:
        """Draw ``count`` scenes, and give their difficulties, ``(count,)``; None without a curriculum.

        Scenes of environments behind the leading ones share one difficulty, uniform below the stage's.
        """
        if not self.curriculum:
            return self.task.sample(count, self._generator), None
        config, num_envs = self.task.config.curriculum, len(progress.stage)
        level = difficulty(progress, config)
        scene = self.task.sample(count, self._generator, scene_difficulty(level, config))
        first = leading(num_envs, config)
        if first == num_envs:
            return scene, level.expand(count)
        below = level * torch.rand((), generator=self._generator, dtype=torch.float64, device=self.device)
        environment = torch.arange(num_envs, device=self.device) if rows is None else rows
        behind = environment >= first
        easier = self.task.sample(count, self._generator, scene_difficulty(below, config))
        return easier.where(behind, scene), torch.where(behind, below, level)

    def _blank(self, count: int) -> Beginning:
        """Give what ``count`` beginnings have in common; where all rows are made at every step, made only once."""
        if count in self._beginnings:
            return self._beginnings[count]
        blank = Beginning(
            rod=straight_rods(self.backend.parameters, count, self.dtype, self.device),
            table=empty_table(count, self.n_slots, self._n_bins, self.device),
            shown=torch.zeros((count, self.n_slots * self.task.moves, 9), dtype=torch.float32, device=self.device),
            previous_action=torch.zeros(
                (count, self.task.config.n_agents, DIRECTIONS), dtype=torch.float32, device=self.device
            ),
            never=torch.zeros(count, dtype=torch.bool, device=self.device),
            whole=torch.ones(count, dtype=torch.float32, device=self.device),
            body=torch.ones((count, 0), dtype=torch.float64, device=self.device),
        )
        if not sync.is_free(self.device):
            self._beginnings[count] = blank
        return blank

    def _push_anew(self, mask: Tensor | None) -> None:
        if self.perturbation is not None:
            self.state.push = self.perturbation.begin(self.state.push, mask)

    def _real(self, value: Tensor) -> Tensor:
        return value.to(self.dtype) if value.is_floating_point() else value

    # a control step

    def step(self, action: Tensor) -> Outcome:
        """Move every environment whose episode is under way.

        Args:
            action: what the policies chose, in [-1, 1], ``(num_envs, n_agents, 2)``.
        """
        state, config = self.state, self.task.config
        now = state.episodes
        rod, previous_action = now.rod, now.previous_action
        active = ~(now.terminated | now.truncated)
        force = None
        if self.perturbation is not None:
            action = self.perturbation.applied(action)
            if self.perturbation.config.pushes:
                state.tip_force = self.perturbation.tip_force(state.push, now.steps, active)
                force = torch.nn.functional.pad(
                    state.tip_force.unsqueeze(-1), (self.backend.parameters.n_elements, 0)
                )  # on the last node
        cylinders = now.scene.cylinders if self.task.max_cylinders else None
        velocity = self._move_cylinders(now, active) if self.task.moves else None
        couple = self._actuation.couple(action)
        bodies = self._bodies(now)
        if bodies is not None:
            couple = couple * self._strength(now).to(self.dtype)[:, None, None]
        pushed = torch.zeros_like(active) if self._counts_pushes else self._unpushed
        moved = self.backend.control_step(
            rod,
            couple,
            force=force,
            cylinders=cylinders,
            active=active,
            cylinder_velocity=velocity,
            bodies=bodies,
            touched=pushed if self._counts_pushes else None,
        )
        broken = diverged(moved, self._rest_length, config.min_dilatation, config.max_dilatation)
        if sync.any_true(broken):
            moved = rod.where(broken, moved)
        now.rod, now.previous_action = moved, action
        sight = self.sense(now)
        self._note(now, sight)
        step = Step(
            before=rod.position,
            after=moved.position,
            target=now.scene.target,
            action=action,
            previous_action=previous_action,
            touching=self.contacts(now),
            pushed=pushed,
            new_bins=sight.new,
            broken=broken,
            terminated=now.terminated,
            truncated=now.truncated,
            steps=now.steps,
            contact_steps=now.contact_steps,
        )
        verdict = judge(step, config, self.horizon)
        if bodies is not None:
            for key in (entries.TORQUE_PER_AGENT, entries.TORQUE_JOINT):  # which the verdict has of nominal sections
                torque = verdict.numbers[key]
                verdict.numbers[key] = torque * self._strength(now).to(torque.dtype).view_as(torque)
        now.steps, now.terminated, now.truncated = verdict.steps, verdict.terminated, verdict.truncated
        now.contact_steps = verdict.contact_steps
        if self.curriculum:
            self._waive(verdict, pushed)
            state.progress = note_ends(state.progress, verdict.ended, verdict.success, config.curriculum)
        return Outcome(sight=sight, broken=broken, verdict=verdict)

    def _waive(self, verdict: Verdict, pushed: Tensor) -> None:
        """Take back from the reward what contact costs less at the difficulty of each episode."""
        waived = waived_cost(self.state.episodes.difficulty, self.task.config)
        if waived is None:
            return
        in_contact = (verdict.numbers[entries.CONTACT_NODES].view_as(pushed) > 0) | pushed
        for key in (entries.REWARD, (entries.REWARD_TERMS, "collision")):
            charged = verdict.numbers[key]
            verdict.numbers[key] = charged + (waived * in_contact).to(charged.dtype).view_as(charged)

    def _move_cylinders(self, episodes: Episodes, active: Tensor) -> Tensor:
        """Bring the scenes of active environments to the end of this control step; bins keep their numbers.

        Returns:
            With which velocity the cylinders move there, m/s, ``(num_envs, n_cylinders, 3)``.
        """
        scene, duration = episodes.scene, self.backend.parameters.control_dt
        episodes.scene = self.task.advance(scene, episodes.steps, duration).where(active, scene)
        episodes.bins = self._cut(episodes.scene)
        return (episodes.scene.cylinders.start - scene.cylinders.start) / duration

    def _cut(self, scene: Scene) -> Bins:
        return cut_into_bins(scene.cylinders, self.task.config.bin_length, self.task.max_cylinder_length)

    def _bodies(self, episodes: Episodes) -> Bodies | None:
        """The factors on the rods' parameters; None: all are the nominal one."""
        return None if self.randomise is None else Bodies(*episodes.body[:, : len(Bodies._fields)].unbind(-1))

    def _strength(self, episodes: Episodes) -> Tensor:
        """The factor on the sections' largest torque, ``(num_envs,)``, where bodies are drawn."""
        return episodes.body[:, FACTORS.index("max_torque")]

    # readings

    def sense(self, episodes: Episodes) -> Sight:
        """Sense, discover and observe obstacles from the agents' places.

        A bin that nobody senses now is shown as it was last sensed: nobody knows where it has moved.
        """
        config, scene = self.task.config, episodes.scene
        position = self.at_agents(episodes.rod.position)
        sight = look(position, scene.cylinders, episodes.bins, episodes.table, config.sensing_radius, config.bin_length)
        if not self.task.moves:
            return sight
        sensed = sight.edge.any(dim=1).unsqueeze(-1)
        return sight._replace(descriptor=torch.where(sensed, sight.descriptor, episodes.shown))

    def _note(self, episodes: Episodes, sight: Sight) -> None:
        """Remember what has been discovered and how it was shown."""
        episodes.table = sight.table
        if self.task.moves:
            episodes.shown = sight.descriptor

    def at_agents(self, of_nodes: Tensor) -> Tensor:
        """Select the agents' nodes: ``(num_envs, 3, n_nodes)`` to ``(num_envs, n_agents, 3)``."""
        return of_nodes.mT.index_select(-2, self._agent_node)

    def contacts(self, episodes: Episodes) -> Tensor:
        """Tell which nodes touch a cylinder, ``(num_envs, n_nodes)`` bool."""
        if not self.task.max_cylinders:
            return self._untouched(len(episodes.steps))
        volume, bodies = self._volume, self._bodies(episodes)
        if bodies is not None:
            own = scales(bodies, self.backend.parameters).volume
            volume = own.to(self.dtype).unsqueeze(-1) * volume
        return contact_nodes(episodes.rod.position, volume, episodes.scene.cylinders)

    def _untouched(self, count: int) -> Tensor:
        never = torch.zeros((), dtype=torch.bool, device=self.device)
        return never.expand(count, self.backend.parameters.n_nodes)

    def count_contacts(self, episodes: Episodes) -> Tensor:
        """Count the nodes in contact, C_t, ``(num_envs,)`` int64."""
        if not self.task.max_cylinders:
            return torch.zeros_like(episodes.steps)
        return self.contacts(episodes).sum(dim=-1)
