"""An actor's memory: the same as torch's GRU, forgets between episodes, is every agent's own."""

import pytest
import torch
from hypothesis import given, settings, strategies
from observations import SEEDS, actor_config
from tensordict import TensorDict

from softgm_bench.envs import entries
from softgm_bench.models.memory import Memory, MemoryConfig

pytestmark = pytest.mark.usefixtures("one_thread")
SIZE, FEATURES, N_AGENTS = 5, 3, 2


def memory(dtype=torch.float64):
    module = Memory(MemoryConfig("gru", SIZE), FEATURES).to(dtype)
    for parameter in module.parameters():
        torch.nn.init.normal_(parameter, std=0.7)
    return module


def frames(n_envs, n_steps, begins=0.3, dtype=torch.float64):
    """``(n_envs, n_steps)``: a state before each frame, of which the first alone counts, and where episodes begin."""
    shape = (n_envs, n_steps, N_AGENTS)
    td = TensorDict({entries.IS_INIT: torch.rand(n_envs, n_steps, 1) < begins}, shape[:2])
    td.set(entries.MEMORY, torch.randn(*shape, SIZE, dtype=dtype))
    return td, torch.randn(*shape, FEATURES, dtype=dtype)


def step_by_step(module, td, inputs):
    states, state = [], td[entries.MEMORY][:, 0]
    for step in range(td.shape[1]):
        now = td[:, step].exclude(entries.MEMORY).set(entries.MEMORY, state)
        states.append(module(now, inputs[:, step]))
        state = now[entries.NEXT_MEMORY]
        assert torch.equal(state, states[-1])
    return torch.stack(states, dim=1)


@settings(deadline=None, max_examples=25)
@given(SEEDS, strategies.integers(1, 4), strategies.integers(1, 6), strategies.sampled_from([0.0, 0.3, 1.0]))
def test_a_sequence_is_its_steps_one_after_another(seed, n_envs, n_steps, begins):
    torch.manual_seed(seed)
    module = memory()
    td, inputs = frames(n_envs, n_steps, begins)
    torch.testing.assert_close(module(td, inputs), step_by_step(module, td, inputs), rtol=1e-12, atol=1e-12)
    assert "next" not in td.keys()  # noqa: SIM118


def test_between_episodes_it_is_torchs_gru():
    torch.manual_seed(0)
    module = memory()
    gru = torch.nn.GRU(FEATURES, SIZE, batch_first=True, dtype=torch.float64)
    for layer, name in ((module.input, "ih"), (module.recurrent, "hh")):
        for kind in ("weight", "bias"):
            getattr(gru, f"{kind}_{name}_l0").data.copy_(getattr(layer, kind))
    td, inputs = frames(4, 7, begins=0.0)
    flat = inputs.transpose(1, 2).flatten(0, 1)  # every agent of every environment is a sequence
    expected, _ = gru(flat, td[entries.MEMORY][:, 0].flatten(0, 1).unsqueeze(0))
    # the house's tanh is the sigmoid's and rounds differently
    torch.testing.assert_close(
        module(td, inputs), expected.unflatten(0, (4, N_AGENTS)).transpose(1, 2), rtol=1e-12, atol=1e-12
    )


@pytest.mark.parametrize("before", [3.0, float("nan"), float("inf")])
def test_nothing_from_before_an_episode_is_left_in_it_bit_for_bit(before):
    torch.manual_seed(0)
    module = memory(torch.float32)
    td, inputs = frames(3, 6, begins=0.0, dtype=torch.float32)
    td[entries.IS_INIT][1, 2] = True
    other, others = td.clone(), inputs.clone()
    others[1, :2] = before
    other[entries.MEMORY][1] = before
    found, expected = module(other, others), module(td, inputs)
    assert torch.equal(found[1, 2:], expected[1, 2:])
    assert torch.equal(found[[0, 2]], expected[[0, 2]])
    now, then = td[:, 2], other[:, 2]
    assert torch.equal(module(now, inputs[:, 2])[1], module(then, others[:, 2])[1])


def test_an_agents_state_depends_on_its_own_inputs_alone():
    torch.manual_seed(0)
    module = memory()
    td, inputs = frames(3, 4)
    changed = inputs.clone()
    changed[..., 1, :] += 1.0
    before, after = module(td, inputs), module(td, changed)
    assert torch.equal(before[..., 0, :], after[..., 0, :])
    assert not torch.isclose(before[..., 1, :], after[..., 1, :]).any()


def test_gradients_reach_back_to_the_episodes_first_step_and_no_further():
    torch.manual_seed(0)
    module = memory()
    td, inputs = frames(1, 6, begins=0.0)
    td[entries.IS_INIT][0, 2] = True
    inputs.requires_grad_()
    module(td, inputs)[0, 5].sum().backward()
    reached = inputs.grad.abs().sum((0, 2, 3)) > 0.0
    assert reached.tolist() == [False, False, True, True, True, True]


def test_without_a_state_it_begins_with_zeros_and_says_so():
    torch.manual_seed(0)
    module = memory()
    td, inputs = frames(2, 1, begins=0.0)
    td = td[:, 0].exclude(entries.MEMORY)
    first = module(td, inputs[:, 0])
    assert torch.equal(td[entries.MEMORY], torch.zeros(2, N_AGENTS, SIZE, dtype=torch.float64))
    assert torch.equal(module(td, inputs[:, 0]), first)  # asked again, it has not moved on


def test_what_is_no_memory_is_refused_in_one_line():
    with pytest.raises(ValueError, match=r"^algo\.actor\.memory\.cell is lstm: choose one of gru$"):
        MemoryConfig("lstm", 8)
    with pytest.raises(ValueError, match=r"^algo\.actor\.memory\.size is 0: it must be at least 1$"):
        MemoryConfig("gru", 0)
    with pytest.raises(ValueError, match=r"reads \(B,\) or \(B, T\) frames$"):
        memory()(TensorDict({entries.IS_INIT: torch.ones(1, 1, 1, 1)}, [1, 1, 1]), torch.zeros(1, 1, 1, 2, 3))
    assert actor_config().memory is None
