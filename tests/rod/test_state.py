import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from softgm_bench.rod.parameters import RodParameters, rod_constants
from softgm_bench.rod.state import dilatation, straight_rods

PARAMETERS = RodParameters(n_elements=7, base_length=0.7)


def test_straight_rods_stand_along_z_at_rest():
    state = straight_rods(PARAMETERS, 2)
    assert state.batch_size == (2,)
    expected = torch.linspace(0.0, 0.7, 8, dtype=torch.float64)
    for i in range(2):
        torch.testing.assert_close(state.position[i, 2], expected, rtol=1e-15, atol=0.0)
        assert (state.position[i, :2] == 0.0).all()
    assert (state.velocity == 0.0).all()
    assert (state.omega == 0.0).all()


def test_directors_at_rest_are_a_right_handed_frame_with_d1_along_y_and_d3_along_z():
    frame = straight_rods(PARAMETERS, 1).director[0].permute(2, 0, 1)  # (n_elements, 3, 3), rows d1, d2, d3
    assert torch.equal(frame[:, 0], torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64).expand(7, 3))
    assert torch.equal(frame[:, 2], torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(7, 3))
    assert torch.equal(torch.linalg.cross(frame[:, 0], frame[:, 1]), frame[:, 2])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_straight_rods_have_the_dtype_asked_for(dtype: torch.dtype):
    state = straight_rods(PARAMETERS, 1, dtype=dtype)
    assert {value.dtype for value in (state.position, state.director, state.velocity, state.omega)} == {dtype}


def test_environments_of_straight_rods_share_no_memory():
    state = straight_rods(PARAMETERS, 2)
    state.position[0] += 1.0
    state.omega[0] += 1.0
    fresh = straight_rods(PARAMETERS, 1)
    assert torch.equal(state.position[1], fresh.position[0])
    assert torch.equal(state.omega[1], fresh.omega[0])


@given(stretch=st.floats(0.1, 10.0), turn=st.floats(-3.0, 3.0))
def test_dilatation_is_the_stretch_of_a_uniformly_stretched_rod_however_turned(stretch: float, turn: float):
    position = stretch * straight_rods(PARAMETERS, 1).position
    sine, cosine = torch.sin(torch.tensor(turn)).item(), torch.cos(torch.tensor(turn)).item()
    rotation = torch.tensor([[1.0, 0.0, 0.0], [0.0, cosine, -sine], [0.0, sine, cosine]], dtype=torch.float64)
    rest_length = torch.as_tensor(rod_constants(PARAMETERS).rest_length)
    actual = dilatation(rotation @ position, rest_length)
    torch.testing.assert_close(actual, torch.full((1, 7), stretch, dtype=torch.float64), rtol=1e-6, atol=0.0)
