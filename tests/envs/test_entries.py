import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule

from softgm_bench.envs import entries, make_env
from softgm_bench.envs.interface import Sizes
from softgm_bench.envs.specs import make_specs
from softgm_bench.episodes.evaluation import evaluate
from softgm_bench.episodes.summary import summarise
from softgm_bench.rod.parameters import RodParameters
from softgm_bench.runs.metrics import step_metrics

SIZES = Sizes(4, 2, n_slots=6, n_privileged=3)


@pytest.fixture
def env(settings):
    return make_env(settings("task=wall").task, RodParameters(n_elements=20, substeps=2), 3, seed=0, horizon=5)


@pytest.fixture
def one_more(monkeypatch):
    """A line in the table, as a new metric needs it."""
    key = ("info", "heat")
    column = entries.Column("heat_at_most", entries.LAST, key)
    seen = entries.Column("heat", entries.MEAN, key)
    monkeypatch.setitem(entries.TABLE, key, entries.Entry(key, (1,), torch.float32, False, (column,), seen))
    monkeypatch.setattr(entries, "EPISODE_COLUMNS", (*entries.EPISODE_COLUMNS, column))
    monkeypatch.setattr(entries, "ITERATION_COLUMNS", (*entries.ITERATION_COLUMNS, seen))
    return key


def test_a_metric_is_in_specs_records_summaries_and_iterations_once_it_is_in_the_table(env, one_more, monkeypatch):
    assert "heat" in make_specs(2, SIZES, torch.device("cpu"))["observation_spec"]["info"].keys()  # noqa: SIM118
    step = env._step

    def hotter(td):
        return step(td).set(one_more, torch.full((3, 1), 7.0))

    monkeypatch.setattr(env, "_step", hotter)
    rest = TensorDictModule(lambda tip: torch.zeros(len(tip), 6, 2), in_keys=[entries.TIP], out_keys=[entries.ACTION])
    records = evaluate(rest, env, deterministic=True, seed=0)
    np.testing.assert_array_equal(records["heat_at_most"], [7.0, 7.0, 7.0])
    assert summarise(records)["heat_at_most"] == {"mean": 7.0, "std": 0.0}
    batch = TensorDict({"next": TensorDict({one_more: torch.tensor([[[1.0], [3.0]]])}, [1, 2])}, [1, 2])
    assert step_metrics(batch) == {"heat": 2.0}


def test_every_entry_of_a_frame_is_in_the_table_with_its_shape_and_type(env):
    frame = env.rand_step(env.reset())["next"]
    for key, value in frame.items(include_nested=True, leaves_only=True):
        entry = entries.TABLE[key]
        assert value.shape == (3, *entries.shape_of(key, env.sizes)), key
        assert value.dtype == entry.dtype, key


def test_columns_have_names_of_their_own():
    for columns in (entries.EPISODE_COLUMNS, entries.ITERATION_COLUMNS):
        names = [column.name for column in columns]
        assert len(names) == len(set(names))


def test_the_state_of_a_simulation_is_a_copy_and_an_earlier_layout_is_still_read(env):
    td = env.reset()
    push = torch.ones(3, 6, 2)
    state = env.simulation_state()
    before = state.clone()
    td = env.step(td.set(entries.ACTION, push))["next"].exclude("reward")
    assert (state == before).all()
    later = env.simulation_state()
    earlier = later["episodes"].clone().set("curriculum", later["progress"].clone()).set("push", later["push"].clone())
    expected = env.step(td.clone().set(entries.ACTION, push))["next"]
    env.reset()
    env.load_simulation_state(earlier)
    found = env.step(td.clone().set(entries.ACTION, push))["next"]
    assert all(torch.equal(expected[key], found[key]) for key in entries.OBSERVATION)
