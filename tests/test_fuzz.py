"""Whatever is in a file or on a command line, the answer is a result or one line: no traceback, no code that is run."""

from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from softgm_bench.assembly import configure
from softgm_bench.config.explain import USER_ERRORS, explain
from softgm_bench.episodes import policy, trajectory
from softgm_bench.errors import UserError
from softgm_bench.runs import checkpoint

POLICIES = Path(__file__).parents[1] / "experiments" / "policies"
POLICY = (POLICIES / "basic_ippo.pt").read_bytes()
in_one_file = settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])

KEYS = st.sampled_from(
    [
        "seed",
        "task",
        "task.n_agents",
        "task.horizon",
        "algo",
        "algo.gamma",
        "model.hidden",
        "experiment.num_envs",
        "rod.n_elements",
        "threads",
        "device",
        "run_dir",
        "perturbation",
        "randomise",
        "randomise.density",
        "logger",
        "+new",
        "~task",
        "algo.critic",
    ]
)
VALUES = st.one_of(
    st.text(max_size=12),
    st.integers().map(str),
    st.floats().map(str),
    st.sampled_from(
        ["null", "true", "[1,2]", "{a: 1}", "${seed}", "${oc.env:HOME}", "'", "wall", "masac", "-1", "1e400"]
    ),
)


@in_one_file
@given(content=st.binary(max_size=200))
def test_bytes_of_any_kind_are_no_checkpoint_and_no_episode(tmp_path: Path, content: bytes):
    for name, load in (("one.pt", checkpoint.load), ("one.npz", trajectory.load)):
        file = tmp_path / name
        file.write_bytes(content)
        with pytest.raises(UserError, match=r"^[^\n]+$"):
            load(file)


@in_one_file
@given(at=st.integers(0, len(POLICY) - 1), flip=st.integers(1, 255))
def test_a_policy_with_a_changed_byte_is_the_same_policy_or_refused(tmp_path: Path, at: int, flip: int):
    file = tmp_path / "changed.pt"
    file.write_bytes(POLICY[:at] + bytes([POLICY[at] ^ flip]) + POLICY[at + 1 :])
    try:
        changed = checkpoint.load(file)
    except UserError as error:
        refusal = str(error)
    else:
        refusal = None
    if refusal is not None:
        assert "\n" not in refusal
        return
    whole = checkpoint.load(POLICIES / "basic_ippo.pt")
    assert changed.keys() == whole.keys()
    for name, value in whole["policy"].items():
        assert not torch.is_tensor(value) or torch.equal(changed["policy"][name], value)


@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(length=st.integers(0, len(POLICY) - 1))
def test_a_policy_that_was_cut_short_is_refused(tmp_path: Path, length: int):
    file = tmp_path / "cut.pt"
    file.write_bytes(POLICY[:length])
    with pytest.raises(UserError, match=r"^[^\n]+$"):
        policy.load(file)


class Mischief:
    """Something that would run code while it is unpickled."""

    def __init__(self, mark: Path):
        self.mark = mark

    def __reduce__(self):
        return Path.touch, (self.mark,)


def test_nothing_in_a_file_is_run(tmp_path: Path):
    mark = tmp_path / "was_here"
    torch.save({"format": checkpoint.FORMATS[-1], "frames": 0, "policy": Mischief(mark)}, tmp_path / "bad.pt")
    np.savez(tmp_path / "bad.npz", metadata=np.array(Mischief(mark), dtype=object))
    for load, name in ((policy.load, "bad.pt"), (checkpoint.load, "bad.pt"), (trajectory.load, "bad.npz")):
        with pytest.raises(UserError, match=r"^[^\n]+$"):
            load(tmp_path / name)
    assert not mark.exists()


@settings(max_examples=40, deadline=None)
@given(overrides=st.lists(st.builds("{}={}".format, KEYS, VALUES) | st.text(max_size=15), min_size=1, max_size=3))
def test_settings_of_any_kind_make_a_configuration_or_one_line(overrides: list[str]):
    line = "composed"
    try:
        configure(overrides)
    except USER_ERRORS as error:
        line = explain(error, overrides)
    assert line.strip()
    assert "\n" not in line
