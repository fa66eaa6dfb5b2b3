import torch
from hypothesis import given
from hypothesis import strategies as st

from softgm_bench.models.finite import not_finite

NUMBERS = st.floats(width=32) | st.sampled_from([1e38, -1e38, 3e38])


@given(st.lists(st.lists(NUMBERS, max_size=5), max_size=4))
def test_exactly_what_is_not_finite_is_found_however_large_the_rest_is(rows):
    named = [(f"t{index}", torch.tensor(row, dtype=torch.float32)) for index, row in enumerate(rows)]
    wrong = [name for name, tensor in named if not tensor.isfinite().all()]

    found = not_finite([("count", torch.tensor([1, 2])), ("nothing", None), *named])

    assert (found is None) == (not wrong)
    assert found is None or found.split()[0] == wrong[0]
