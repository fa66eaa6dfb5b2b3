"""The line by which settings are refused."""

import pytest

from softgm_bench.assembly import configure
from softgm_bench.config.explain import USER_ERRORS, explain


def refusal(*overrides):
    """The line that these overrides are answered with."""
    with pytest.raises(USER_ERRORS) as caught:
        configure(list(overrides))
    line = explain(caught.value, list(overrides))
    assert "\n" not in line
    return line
