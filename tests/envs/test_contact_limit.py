"""A task may end an episode as failed after too many control steps of contact, and have a surface of its own."""

import dataclasses
from contextlib import nullcontext

import pytest
import torch

from dense import force_dense
from softgm_bench.envs import entries, make_env
from softgm_bench.envs.verdict import judge_dense
from softgm_bench.episodes.evaluation import evaluate
from softgm_bench.episodes.summary import summarise
from softgm_bench.rod.parameters import RodParameters

ROD = RodParameters(substeps=50)
PRESS = torch.tensor([1.0, 0.4])  # to the wall and along it, so that the tip does not rest between two columns


def pressing(env, steps, without_obstacles=False):
    """Frames of arms that bend towards the wall and lean on it."""
    action = PRESS.expand(env.batch_size[0], 6, 2)
    td, frames = env.reset(), []
    if without_obstacles:
        env.scene.cylinders.mask.zero_()
    for _ in range(steps):
        td = env.step(td.set(entries.ACTION, action))["next"]
        frames.append(td.clone())
    return frames


@pytest.fixture
def limited(settings):
    def build(limit, num_envs=3, task=None, **options):
        changes = {"max_contact_steps": limit, "wall_x": 0.25} | (task or {})
        config = dataclasses.replace(settings("task=wall_touch").task, **changes)
        return make_env(config, ROD, num_envs, seed=0, **options)

    return build


def test_one_step_of_contact_too_many_ends_an_episode_as_failed(limited):
    env = limited(4)
    frames = pressing(env, 60)
    touched = torch.stack([frame[entries.CONTACT_NODES].squeeze(-1) > 0.0 for frame in frames])
    failed = torch.stack([frame[entries.CONTACT_FAILURE].squeeze(-1) for frame in frames])
    terminated = torch.stack([frame[entries.TERMINATED].squeeze(-1) for frame in frames])
    for row in range(3):
        fifth = int((touched[:, row].cumsum(0) == 5).nonzero()[0])
        assert failed[:, row].nonzero().flatten().tolist() == [fifth]
        assert not terminated[:fifth, row].any()
        assert terminated[fifth:, row].all()
        assert frames[fifth][entries.REWARD_TERMS, "collision"][row] < -env.task.config.reward.lambda_fail + 1e-3
        assert frames[fifth - 1][entries.REWARD_TERMS, "collision"][row] > -1.0


def test_the_count_begins_anew_with_an_episode(limited):
    env = limited(4)
    frames = pressing(env, 60)
    assert (env.simulator.state.episodes.contact_steps == 5).all()
    mask = torch.tensor([True, False, False])
    env.reset(frames[-1].clone().set("_reset", mask.unsqueeze(-1)))
    assert env.simulator.state.episodes.contact_steps.tolist() == [0, 5, 5]


@pytest.fixture
def eased(limited, settings):
    def build(curriculum, **options):
        task = settings("task=wall_touch", "task.curriculum.enabled=true", "task.curriculum.stages=4").task
        config = dataclasses.replace(task.curriculum, easy_contact_steps=6)
        return limited(2, task={"curriculum": config}, curriculum=curriculum, **options)

    return build


@pytest.mark.parametrize("dense", [False, True], ids=["rows", "all rows"])
@pytest.mark.parametrize("stage", range(5))
def test_easier_scenes_allow_more_contact_and_the_tasks_own_no_more_than_the_task(eased, stage, dense):
    env = eased(True)
    state = env.simulation_state()
    state["progress", "stage"].fill_(stage)
    env.load_simulation_state(state)
    with force_dense() if dense else nullcontext():
        frames = pressing(env, 70)
    touched = torch.stack([frame[entries.CONTACT_NODES].squeeze(-1) > 0.0 for frame in frames]).cumsum(0)
    failed = torch.stack([frame[entries.CONTACT_FAILURE].squeeze(-1) for frame in frames])
    for row in range(3):
        last = int((touched[:, row] == 7 - stage).nonzero()[0])  # 6, 5, 4, 3, 2 are allowed
        assert failed[:, row].nonzero().flatten().tolist() == [last]


@pytest.mark.parametrize("dense", [False, True], ids=["rows", "all rows"])
@pytest.mark.parametrize("stage", [0, 2, 4])
def test_a_step_in_contact_costs_less_in_easier_scenes_and_nothing_else_does(limited, settings, stage, dense):
    """As if the whole run had the cost of the stage."""
    task = settings("task=wall_touch", "task.curriculum.enabled=true", "task.curriculum.stages=4").task
    waiving = dataclasses.replace(task.curriculum, easy_lambda_c=-1.0)
    played = []
    for curriculum, cost in ((waiving, -5.0), (task.curriculum, -1.0 - stage)):
        changes = {"curriculum": curriculum, "reward": dataclasses.replace(task.reward, lambda_c=cost)}
        env = limited(2, task=changes, curriculum=True)
        state = env.simulation_state()
        state["progress", "stage"].fill_(stage)
        env.load_simulation_state(state)
        with force_dense() if dense else nullcontext():
            played.append(pressing(env, 40))
    assert any((frame[entries.CONTACT_NODES] > 0.0).any() for frame in played[0])
    for waived, dear in zip(*played, strict=True):
        for key in (entries.REWARD, *((entries.REWARD_TERMS, name) for name in entries.REWARD_TERM_NAMES)):
            torch.testing.assert_close(waived[key], dear[key], rtol=1e-5, atol=1e-5)


def test_evaluations_allow_what_the_task_does_whatever_training_began_with(eased):
    env = eased(False)
    assert not env.simulator.state.episodes.contact_steps.any()
    pressing(env, 60)
    assert (env.simulator.state.episodes.contact_steps == 3).all()


def test_environments_behind_the_leading_ones_allow_what_their_own_difficulty_does(settings):
    words = ("enabled=true", "stages=4", "easier_share=0.5", "easy_contact_steps=100")
    task = settings("task=wall_touch", *(f"task.curriculum.{word}" for word in words)).task
    env = make_env(task, ROD, 4, seed=0, curriculum=True)
    state = env.simulation_state()
    state["progress", "stage"].fill_(3)
    env.load_simulation_state(state)
    env.reset()
    episodes = env.simulator.state.episodes
    assert episodes.difficulty[0] == 0.75 > episodes.difficulty[3]
    further = (100 - task.max_contact_steps) * (1.0 - episodes.difficulty)
    assert torch.equal(-episodes.contact_steps, further.round().to(torch.int64))


def test_scenes_may_become_the_tasks_own_before_the_limit_of_contact_does(settings):
    words = ("enabled=true", "stages=4", "contact_stages=2", "easy_contact_steps=100")
    task = settings("task=wall_touch", *(f"task.curriculum.{word}" for word in words)).task
    env, plain = (make_env(task, ROD, 4, seed=0, curriculum=curriculum) for curriculum in (True, False))
    state = env.simulation_state()
    for stage, further in ((1, 90), (2, 90), (3, 45), (4, 0)):
        state["progress", "stage"].fill_(stage)
        env.load_simulation_state(state)
        for each in (env, plain):
            each.set_seed(7)
            each.reset()
        drawn, own = (each.simulator.state.episodes for each in (env, plain))
        assert (drawn.contact_steps == -further).all()
        assert (drawn.difficulty == stage / 4).all()
        assert torch.equal(drawn.scene.target, own.scene.target) is (stage >= 2)


def test_contact_that_ends_an_episode_is_no_success_even_at_the_target(settings):
    from envs_steps import one_step

    config = dataclasses.replace(settings("task=wall_touch").task, max_contact_steps=2)
    for contact_steps, touching, success in ((1, True, True), (2, False, True), (2, True, False)):
        verdict = judge_dense(one_step(contact_steps=contact_steps, touching=touching), config, 100)
        assert verdict.success.item() is success
        assert verdict.terminated.item()
        assert verdict.contact_failure.item() is not success


def test_a_push_within_a_step_counts_where_the_task_says_so(settings):
    from envs_steps import one_step

    config = dataclasses.replace(settings("task=wall_touch").task, max_contact_steps=2)
    verdict = judge_dense(one_step(contact_steps=2, touching=False, pushed=True), config, 100)
    assert verdict.contact_failure.item()
    assert verdict.contact_steps.item() == 3


@pytest.mark.parametrize("dense", [False, True], ids=["rows", "all rows"])
def test_an_arm_that_leans_by_its_last_half_element_is_in_contact_within_steps_and_not_at_their_ends(limited, dense):
    """PyElastica's last element reaches half its length beyond the tip, and touches there before any node does."""
    steps = 36
    with force_dense() if dense else nullcontext():
        ends, within = (limited(1000, task={"contact_counts": counts}) for counts in ("at_end", "within"))
        frames = [pressing(env, steps)[-1] for env in (ends, within)]
    at_ends, pushes = (env.simulator.state.episodes.contact_steps for env in (ends, within))
    assert torch.equal(frames[0][entries.TIP], frames[1][entries.TIP])  # to count is all that it does
    assert (pushes > at_ends).all()


def test_until_a_step_counts_as_contact_the_arm_moves_as_if_there_was_no_wall(limited):
    walled, bare = limited(0, task={"contact_counts": "within"}), limited(0)
    frames, free = pressing(walled, 60), pressing(bare, 60, without_obstacles=True)
    failed = torch.stack([frame[entries.CONTACT_FAILURE].squeeze(-1) for frame in frames])
    tips, free_tips = (torch.stack([frame[entries.TIP] for frame in played]) for played in (frames, free))
    for row in range(3):
        first = int(failed[:, row].nonzero()[0])
        assert torch.equal(tips[:first, row], free_tips[:first, row])
        assert not torch.equal(tips[first, row], free_tips[first, row])


def test_an_unknown_way_to_count_is_refused(settings):
    with pytest.raises(ValueError, match=r"task.contact_counts is 'nodes': it must be at_end or within"):
        dataclasses.replace(settings("task=wall_touch").task, contact_counts="nodes")


def test_an_evaluation_tells_where_failures_end(limited):
    env = limited(0, horizon=60)

    def press(td):
        return td.set(entries.ACTION, PRESS.expand(*td.batch_size, 6, 2).clone())

    records = evaluate(press, env, deterministic=True, seed=0)
    assert records["contact_failure"].all()
    assert not records["success"].any()
    assert (records["contact_steps"] == 1).all()
    assert summarise(records)["contact_failure"] == 3


@pytest.mark.parametrize("task", ["basic", "wall"])
def test_without_a_limit_nothing_is_counted_or_told(settings, task):
    env = make_env(settings(f"task={task}").task, ROD, 2, seed=0)
    frames = pressing(env, 40)
    assert entries.CONTACT_FAILURE not in frames[-1].keys(include_nested=True)
    assert not env.simulator.state.episodes.contact_steps.any()


def test_a_state_of_before_there_was_a_count_is_taken_over(limited):
    env = limited(4)
    pressing(env, 3)
    state = env.simulation_state()
    del state["episodes", "contact_steps"]
    other = limited(4)
    other.load_simulation_state(state)
    assert torch.equal(other.rod.position, env.rod.position)
    assert not other.simulator.state.episodes.contact_steps.any()


def test_a_tasks_surface_takes_the_place_of_the_rods(settings):
    config = settings("task=wall_search").task
    smooth = dataclasses.replace(config, friction_coefficient=0.0)
    rough, without, rods = (
        make_env(task, dataclasses.replace(ROD, friction_coefficient=0.1), 2, seed=0)
        for task in (config, smooth, dataclasses.replace(config, friction_coefficient=None))
    )
    assert rough.backend.parameters.friction_coefficient == 0.5
    assert without.backend.parameters.friction_coefficient == 0.0
    assert rods.backend.parameters.friction_coefficient == 0.1
    one, other = (pressing(env, 40)[-1] for env in (rough, without))
    assert not torch.allclose(one[entries.TIP], other[entries.TIP], atol=1e-4)
