"""What an arm that feels nothing can do, by geometry: the script behind the table on the tasks' page."""

import json
import re
import sys
from pathlib import Path

import pytest
import torch

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "benchmarks"))

import blind_success  # noqa: E402

from every_task import FELT  # noqa: E402
from softgm_bench.config import compose  # noqa: E402
from softgm_bench.envs.tasks import make_task  # noqa: E402
from softgm_bench.episodes import certified  # noqa: E402

FIGURES = json.loads((ROOT / "benchmarks/results/blind_success.json").read_text())
PAGE = (ROOT / "docs/tasks.md").read_text()


def wall():
    return make_task(compose(["task=wall", "recipe=paper"]).task)


def test_one_place_for_all_openings_is_passed_at_the_first_try():
    assert blind_success.coverage(wall(), torch.tensor([[0.0, 0.5]] * 10, dtype=torch.float64), 2) == [1.0, 1.0]


def test_openings_far_apart_take_a_try_each_and_the_commonest_comes_first():
    places = torch.tensor([[-0.2, 0.4]] * 1 + [[0.2, 0.4]] * 2 + [[0.0, 0.6]] * 3, dtype=torch.float64)
    assert blind_success.coverage(wall(), places, 3) == pytest.approx([3 / 6, 5 / 6, 1.0])


def test_an_opening_leaves_the_arms_radius_free_of_columns():
    low, high = blind_success.room(wall(), torch.tensor([[0.0, 0.5]], dtype=torch.float64))
    # axes at +-0.04 and +-0.12 are cut, those at +-0.2 are not
    assert torch.allclose(high, torch.tensor([[0.2 - 0.04 - 0.05, 0.5 + 0.15 - 0.04 - 0.05]], dtype=torch.float64))
    assert torch.allclose(low, torch.tensor([[-0.11, 0.44]], dtype=torch.float64))


def test_a_target_that_tells_the_opening_explains_it_and_one_that_does_not_does_not():
    generator = torch.Generator().manual_seed(0)
    target, other = torch.rand((2, 4000, 3), generator=generator, dtype=torch.float64)
    told = blind_success.explained(target[:, :2] * 2.0, target)
    assert min(told["linear_along"], told["linear_height"]) > 0.999
    untold = blind_success.explained(other[:, :2], target)
    assert max(untold.values()) < 0.01


def test_the_page_has_the_figures():
    told = {row["task"]: row for row in FIGURES["told"]}
    for row in FIGURES["blind"]:
        shares = [f"{row[f'tries_{tries}']:.2f}" for tries in (1, 2, 6)]
        explained = [f"{abs(told[row['task']][f'linear_{axis}']):.2f}" for axis in ("along", "height")]
        assert "| " + " | ".join([f"`{row['task']}`", *shares, *explained]) + " |" in PAGE


def test_a_side_that_the_target_tells_is_told_and_one_that_it_does_not_is_guessed():
    target = torch.rand((4000, 3), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    assert blind_success.side_told(target[:, 1] > 0.5, target) > 0.97
    assert 0.45 < blind_success.side_told(torch.arange(4000) % 2 == 0, target) < 0.55


def test_the_page_says_at_which_difficulty_targets_tell_the_open_side():
    for row in FIGURES["sides"]:
        shares = [f"{row[f'{difficulty:g}']:.2f}" for difficulty in blind_success.DIFFICULTIES]
        assert "| " + " | ".join([f"`{row['task']}`", *shares]) + " |" in PAGE


@pytest.mark.parametrize("name", ["wall", *FELT])
def test_the_page_has_the_number_of_certified_scenes(name):
    known = certified.of_task(name)
    row = re.search(rf"\| `{name}` \| (\d+) \| (\d+) \| (\d+) \|", PAGE)
    assert row is not None
    assert [int(value) for value in row.groups()] == [(known.length > 0).sum(), (known.tried > 0).sum(), known.scenes]
