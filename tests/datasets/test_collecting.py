"""What is collected and unpacked again is what the environment showed, bit by bit."""

import numpy as np
import pytest
import torch
from small import POLICY, Asked, played, write

from softgm_bench.datasets import collecting, layout
from softgm_bench.datasets.reading import load
from softgm_bench.envs import Sizes, entries
from softgm_bench.episodes.evaluation import EpisodeRecords

CASES = {
    "basic": Asked(["random", POLICY.format(task="basic")]),
    "wall": Asked([POLICY.format(task="wall"), "random"], horizon=12, transitions=80, deterministic=True),
    "noise": Asked(["random"], ["task=wall", "perturbation=noise", "task.n_agents=4", "rod.n_elements=20"]),
}


@pytest.mark.parametrize("asked", CASES.values(), ids=CASES)
def test_transitions_are_the_steps_of_the_environment(asked, tmp_path):
    write(tmp_path / "x", asked)
    data = load(tmp_path / "x")
    transitions = data.storage(reward_terms=True)[:]
    episodes, compared = data.episodes, 0
    for number, part in sorted(set(zip(episodes["policy"].tolist(), episodes["part"].tolist(), strict=True))):
        steps, alive = played(asked, number, part)
        for episode in np.flatnonzero((episodes["policy"] == number) & (episodes["part"] == part)):
            own = transitions[transitions["episode"] == int(episode)]
            told = steps[int(episodes["environment"][episode])][alive[int(episodes["environment"][episode])]]
            assert len(own) == episodes["length"][episode] == len(told)
            for key, value in own.items(include_nested=True, leaves_only=True):
                if key not in ("episode", "policy"):
                    assert torch.equal(value, told[key]), key
            assert (own["policy"] == number).all()
            compared += len(own)
    assert compared == data.transitions >= asked.transitions
    if asked is CASES["wall"]:
        assert transitions["next", "agents", "edge"].any()  # the case has obstacles in sight


class Env:
    """What a collector asks of an environment with five slots."""

    sizes = Sizes(2, 2, n_slots=5)
    batch_size = torch.Size([2])

    def __init__(self, step):
        self.observation_spec = step.select(*layout.PACKED)


def step(descriptors, done=False):
    """One step of two episodes that see so many obstacles, whose descriptors are these numbers, before and after it."""

    def frame(numbers):
        values = torch.zeros(2, 5, 9)
        active = torch.zeros(2, 5, dtype=torch.bool)
        for row, own in enumerate(numbers):
            values[row, : len(own)] = torch.tensor(own, dtype=torch.float32).unsqueeze(-1)
            active[row, : len(own)] = True
        edge = torch.zeros(2, 2, 5, dtype=torch.bool)
        pairs = ((entries.SLOT_DESCRIPTOR, values), (entries.SLOT_ACTIVE, active), (entries.EDGE, edge))
        return layout.nested(dict(pairs), 2)

    before, after = (frame(numbers) for numbers in descriptors)
    for key in layout.PAID:
        after.set(key, torch.full((2, 1), done and key != entries.REWARD))
    before.set(entries.ACTION, torch.zeros(2, 2, 2))
    return before.set("next", after)


def test_obstacles_that_stay_are_stored_once_and_those_that_move_in_every_frame():
    still = [[3.0], [3.0, 4.0], [3.0, 4.0]]
    moving = [[5.0, 6.0], [5.5, 6.0], [7.0]]
    told = [step([[still[0], moving[0]], [still[1], moving[1]]])]
    told.append(step([[still[1], moving[1]], [still[2], moving[2]]], done=True))
    counted: list[int] = []
    collector = collecting.Collector(Env(told[0]), counted.append)
    for one in told:
        collector.keep(one, torch.ones(2, dtype=torch.bool))
    length = EpisodeRecords({"length": np.array([2, 2])})
    content = collector.content(length, {"policy": 0, "part": 0, "seed": 1}, first=7, at_least=4)
    assert counted == [2, 2]
    assert content[layout.TABLE, "descriptor"][:, 0].tolist() == [3.0, 4.0, 5.0, 6.0, 5.5, 6.0, 7.0]
    frames = content[layout.FRAMES]
    assert frames["episode"].tolist() == [7, 7, 7, 8, 8, 8]
    assert frames["final"].squeeze(-1).tolist() == [False, False, True] * 2
    shown = layout.unpack(frames, content[layout.TABLE, "descriptor"], Env.sizes)
    for row, numbers in enumerate([*still, *moving]):
        assert shown[entries.SLOT_DESCRIPTOR][row, :, 0].tolist() == numbers + [0.0] * (5 - len(numbers))
        assert shown[entries.SLOT_ACTIVE][row].sum() == len(numbers)


def test_as_many_whole_episodes_are_taken_as_are_asked_for():
    one = step([[[1.0], [2.0]], [[1.0], [2.0]]], done=True)
    for at_least, taken in ((1, 1), (2, 2), (99, 2)):
        collector = collecting.Collector(Env(one), lambda count: None)
        collector.keep(one, torch.ones(2, dtype=torch.bool))
        length = EpisodeRecords({"length": np.array([1, 1])})
        content = collector.content(length, {"policy": 0, "part": 0, "seed": 1}, 0, at_least)
        assert len(content[layout.EPISODES]) == taken
        assert len(content[layout.FRAMES]) == 2 * taken
        assert len(content[layout.TABLE]) == taken


def test_slots_out_of_order_are_refused():
    one = step([[[1.0], [2.0]], [[1.0], [2.0]]])
    one[entries.SLOT_ACTIVE][0] = torch.tensor([False, True, False, False, False])
    with pytest.raises(ValueError, match="active slots are not the first ones"):
        collecting.Collector(Env(one), lambda count: None).keep(one, torch.ones(2, dtype=torch.bool))
