"""What a policy is shown under each intervention, and that nothing else changes."""

from pathlib import Path

import numpy as np
import pytest
import torch
from tensordict.nn import TensorDictModule

from softgm_bench import api
from softgm_bench.envs import entries, make_env
from softgm_bench.episodes.evaluation import evaluate
from softgm_bench.episodes.interventions import INTERVENTIONS, OBSTACLES
from softgm_bench.errors import UserError
from softgm_bench.rod.parameters import RodParameters

POLICIES = Path(__file__).parents[2] / "experiments" / "policies"
NAMES = [name for name in INTERVENTIONS if name not in ("none", "forget")]  # the latter is of policies that remember
CHANGED = {
    "blind": set(OBSTACLES),
    "swap_obstacles": set(OBSTACLES),
    "sensed_only": {entries.SLOT_ACTIVE, entries.SLOT_DESCRIPTOR},
    "swap_opening": {entries.PRIVILEGED},
    "hide_lengths": {entries.SLOT_DESCRIPTOR},
}

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def build(settings):
    def environment(num_envs=5, **options):
        task = settings("task=wall", "task.sensing_radius=0.45").task
        return make_env(task, RodParameters(n_elements=20, substeps=5), num_envs=num_envs, seed=0, **options)

    return environment


@pytest.fixture(scope="module")
def frame(build):
    """A frame in which slots are active that no agent senses any more."""
    env = build()
    td = env.reset()
    torch.manual_seed(0)
    td.update(env.observation_spec.rand())
    td[entries.SLOT_DESCRIPTOR] = torch.where(td[entries.SLOT_ACTIVE].unsqueeze(-1), torch.rand(5, 128, 9), 0.0)
    td[entries.EDGE] &= td[entries.SLOT_ACTIVE].unsqueeze(-2) & (torch.rand(5, 6, 128) < 0.1)
    return td


@pytest.mark.parametrize("name", NAMES)
def test_an_intervention_changes_what_it_says_in_a_copy_and_nothing_else(frame, name):
    before = frame.clone()
    shown = INTERVENTIONS[name](frame)
    assert set(shown.keys(True, True)) == set(frame.keys(True, True))
    assert {key for key in frame.keys(True, True) if not torch.equal(shown[key], before[key])} == CHANGED[name]
    assert (frame == before).all()
    for key in frame.keys(True, True):
        assert (shown[key].shape, shown[key].dtype) == (frame[key].shape, frame[key].dtype)


def test_the_blind_see_no_slot_and_no_edge(frame):
    shown = INTERVENTIONS["blind"](frame)
    assert not any(shown[key].any() for key in OBSTACLES)


@pytest.mark.parametrize(("name", "keys"), [("swap_obstacles", OBSTACLES), ("swap_opening", (entries.PRIVILEGED,))])
def test_a_swap_shows_every_scene_once_and_none_its_own(frame, name, keys):
    shown = INTERVENTIONS[name](frame)
    for key in keys:
        sources = [
            [index for index, other in enumerate(frame[key]) if torch.equal(row, other)] for row in shown[key].clone()
        ]
        assert sorted(source for (source,) in sources) == list(range(len(frame)))
        assert all(source != index for index, (source,) in enumerate(sources))


def test_what_is_not_sensed_now_is_forgotten_and_what_is_stays(frame):
    shown = INTERVENTIONS["sensed_only"](frame)
    sensed = frame[entries.EDGE].any(-2)
    assert torch.equal(shown[entries.SLOT_ACTIVE], sensed)
    assert (frame[entries.SLOT_ACTIVE] & ~sensed).any()
    assert torch.equal(shown[entries.SLOT_DESCRIPTOR][sensed], frame[entries.SLOT_DESCRIPTOR][sensed])
    assert not shown[entries.SLOT_DESCRIPTOR][~sensed].any()


def test_of_a_descriptor_length_and_axial_position_are_hidden(frame):
    shown, descriptor = INTERVENTIONS["hide_lengths"](frame)[entries.SLOT_DESCRIPTOR], frame[entries.SLOT_DESCRIPTOR]
    assert torch.equal(shown[..., :7], descriptor[..., :7])
    assert not shown[..., 7:].any()
    assert (descriptor[frame[entries.SLOT_ACTIVE]][:, 7] > 0).all()


@pytest.mark.parametrize("name", NAMES)
def test_the_world_and_its_scenes_are_the_same_for_a_policy_that_does_not_look(build, name):
    """Actions that read only what no intervention changes lead to the same episodes, which end at different times."""

    def act(tip, position):
        return (torch.stack([tip[..., 0], position[:, 0, 2]], -1) * 9).sin().unsqueeze(-2).expand(-1, 6, 2).clone()

    keys = [entries.TIP, entries.AGENT_POSITION]
    policy = TensorDictModule(act, keys, [entries.ACTION])
    plain, intervened = (
        evaluate(policy, build(horizon=4), deterministic=True, seed=3, show=INTERVENTIONS[which])
        for which in ("none", name)
    )
    for column in plain:
        np.testing.assert_array_equal(plain[column], intervened[column])


def test_another_scene_stays_the_same_one_while_episodes_end(build):
    """With the opening for an action, a policy that is told another scene's is told it to the end."""
    told = []

    def act(privileged):
        told.append(privileged.clone())
        return torch.zeros(len(privileged), 6, 2)

    env = build(horizon=4)
    first = env.set_seed(3) and env.reset()[entries.PRIVILEGED].clone()
    policy = TensorDictModule(act, [entries.PRIVILEGED], [entries.ACTION])
    step, ends = env.step, torch.tensor([1, 9, 2, 9, 3])

    def ending(data):  # episodes end one by one
        out = step(data)
        out["next", entries.DONE].copy_((ends <= len(told)).unsqueeze(-1) | (len(told) >= 4))
        return out

    env.step = ending
    evaluate(policy, env, deterministic=True, seed=3, show=INTERVENTIONS["swap_opening"])
    expected = first.roll(-1, 0)
    for index, seen in enumerate(told):
        assert torch.equal(seen, expected[ends > index])
    assert [len(seen) for seen in told] == [5, 4, 3, 2]


def test_a_policy_that_looks_acts_otherwise_and_the_same_without_an_intervention():
    trained = api.load(POLICIES / "wall_mappo.pt", "rod.n_elements=20", "task.sensing_radius=0.45")

    def distances(**options):
        return api.evaluate(trained, episodes=3, horizon=6, **options).records["final_distance"]

    plain = distances()
    np.testing.assert_array_equal(plain, distances(intervention="none"))
    for name in ("blind", "swap_obstacles", "hide_lengths"):
        assert (distances(intervention=name) != plain).any()


def test_softgm_reads_only_what_is_sensed_now():
    trained = api.load(POLICIES / "wall_softgm.pt", "rod.n_elements=20", "task.sensing_radius=0.45")
    plain, sensed = (
        api.evaluate(trained, episodes=3, horizon=6, intervention=name).records["final_distance"]
        for name in ("none", "sensed_only")
    )
    np.testing.assert_array_equal(plain, sensed)


@pytest.mark.parametrize(
    ("policy", "options", "says"),
    [
        ("wall_softgm.pt", {"intervention": "deaf"}, "intervention=deaf: choose one of none, blind, swap_obstacles, "),
        ("wall_softgm.pt", {"intervention": "swap_opening"}, "this policy is told no opening; an oracle's is"),
        ("basic_softgm.pt", {"intervention": "blind"}, "intervention=blind: task=basic shows no obstacles"),
        ("wall_softgm.pt", {"intervention": "swap_obstacles", "episodes": 1}, "takes another scene: episodes=1 with"),
        ("wall_softgm.pt", {"intervention": "swap_obstacles", "batch": 2, "episodes": 5}, "batch=2 plays one alone"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(policy, options, says):
    with pytest.raises(UserError, match=says) as refusal:
        api.evaluate(POLICIES / policy, **({"episodes": 3, "horizon": 2} | options))
    assert "\n" not in str(refusal.value)
