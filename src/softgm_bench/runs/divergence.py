"""A training whose numbers are no longer finite is stopped before such a policy is kept or called a result."""

import math
from collections.abc import Mapping, Sequence

from tensordict import TensorDictBase

from softgm_bench.algorithms import Algorithm, named_parameters
from softgm_bench.envs import entries
from softgm_bench.errors import NotFinite
from softgm_bench.models.finite import not_finite


def check_update(algorithm: Algorithm, batches: Sequence[TensorDictBase], metrics: Mapping[str, float]) -> None:
    """Look at an update's losses and gradient norms, the actions that it learnt from, and the networks that it left.

    A device is waited for once.

    Args:
        algorithm: after the update.
        batches: that it has learnt from.
        metrics: that it gave. What begins with ``loss_`` or ends in ``_grad_norm`` must be finite, unless
            ``gradient_steps`` says that no step was taken.

    Raises:
        NotFinite: naming the first tensor that is not finite.
    """
    if metrics.get("gradient_steps") != 0:
        for name, value in metrics.items():
            if not math.isfinite(value) and (name.startswith("loss_") or name.endswith("_grad_norm")):
                raise NotFinite(f"{name} is {value}")
    chosen = [("the action", batch[entries.ACTION]) for batch in batches]
    parameters = [(f"the parameter {name}", parameter) for name, parameter in named_parameters(algorithm)]
    found = not_finite([*chosen, *parameters])
    if found is not None:
        raise NotFinite(found)
