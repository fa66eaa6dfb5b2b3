"""With a budget of minutes, training ends while there is time for the final evaluation; without one, never early."""

import csv
import json

import pytest
from interrupted import SMALL

from softgm_bench.config import compose
from softgm_bench.errors import UserError
from softgm_bench.runs import loop
from softgm_bench.runs.budget import MARGIN, WRITING, Budget
from softgm_bench.runs.loop import train

ENDLESS = ("experiment.total_frames=100_000_000", "experiment.evaluation.interval=100_000_000")


class Clock:
    """A clock that stands until it is moved."""

    def __init__(self):
        self.now = 1000.0

    def __call__(self):
        return self.now


class Ticking(Clock):
    """A clock that is a twentieth of a second later whenever it is read, on a machine of any speed."""

    def __call__(self):
        self.now += 0.05
        return self.now


def test_training_stops_at_the_last_iteration_after_which_the_evaluation_still_fits():
    clock = Clock()
    budget = Budget(10.0, clock)  # 600 s
    budget.measured(2.0, 20)
    budget.measured(1.0, 100)  # the slowest evaluation counts
    evaluation = MARGIN * 0.1 * 1000 + WRITING
    stopped = None
    clock.now += 60.0
    budget.lap()  # the first iteration, with everything compiled
    while stopped is None:
        clock.now += 7.0
        budget.lap()
        if budget.is_short(1000):
            stopped = budget.left
    assert evaluation - 7.0 < stopped - 7.0 < evaluation <= stopped


def test_a_slow_iteration_is_reserved_for_unless_it_was_the_first():
    for slow_one, short in ((0, False), (1, True)):
        clock = Clock()
        budget = Budget(1.0, clock)
        for lap in range(3):
            clock.now += 15.0 if lap == slow_one else 5.0
            budget.lap()
        clock.now += 22.0
        assert budget.is_short(0) is short  # 13 s are left


def test_without_minutes_nothing_is_short():
    clock = Clock()
    budget = Budget(None, clock)
    budget.measured(1e9, 1)
    clock.now += 1e9
    budget.lap()
    assert not budget.is_short(10**9)
    assert not budget.limited


@pytest.mark.parametrize("minutes", ["0", "-1"])
def test_minutes_that_are_no_time_are_refused(minutes, settings):
    with pytest.raises(UserError, match=r"^experiment\.minutes=\S+: it must be above 0, or null$"):
        settings(f"experiment.minutes={minutes}")


def test_a_run_ends_in_its_time_with_its_summary_and_can_be_resumed_with_as_much_again(tmp_path, capsys, monkeypatch):
    clock = Ticking()
    monkeypatch.setattr(loop, "Budget", lambda minutes: Budget(minutes, clock))
    limited = [*SMALL, *ENDLESS, f"run_dir={tmp_path}", "experiment.minutes=0.06"]
    first = train(compose(limited))

    rows = list(csv.DictReader((tmp_path / "metrics.csv").open()))
    assert 1000.0 + 0.5 * 3.6 < clock.now <= 1000.0 + 3.6
    assert 0 < first["frames"] == int(rows[-1]["frames"]) < 100_000_000
    assert json.loads((tmp_path / "summary.json").read_text()) == first
    assert f"training stops here, after {first['frames']} frames" in capsys.readouterr().err
    assert compose(limited).experiment.minutes == 0.06

    second = train(compose([*limited, "resume=true", "experiment.minutes=0.05"]))
    assert second["frames"] > first["frames"]
