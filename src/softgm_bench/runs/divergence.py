"""A training whose numbers are no longer finite is stopped before such a policy is kept or called a result."""

import math
from collections.abc import Iterator, Mapping

from tensordict import TensorDictBase
from torch import Tensor, nn

from softgm_bench.algorithms import Algorithm
from softgm_bench.envs import entries
from softgm_bench.errors import NotFinite
from softgm_bench.models.finite import not_finite


def check_update(algorithm: Algorithm, batch: TensorDictBase, metrics: Mapping[str, float]) -> None:
    """Look at an update's losses and gradient norms, the actions that it learnt from, and the networks that it left.

    A device is waited for once.

    Args:
        algorithm: after the update.
        batch: that it has learnt from.
        metrics: that it gave. What begins with ``loss_`` or ends in ``_grad_norm`` must be finite, unless
            ``gradient_steps`` says that no step was taken.

    Raises:
        NotFinite: naming the first tensor that is not finite.
    """
    if metrics.get("gradient_steps") != 0:
        for name, value in metrics.items():
            if not math.isfinite(value) and (name.startswith("loss_") or name.endswith("_grad_norm")):
                raise NotFinite(f"{name} is {value}")
    found = not_finite([("the action", batch[entries.ACTION]), *_parameters(algorithm)])
    if found is not None:
        raise NotFinite(found)


def _parameters(algorithm: Algorithm) -> Iterator[tuple[str, Tensor]]:
    """Parameters of every network that the algorithm holds, each once, the policy's first."""
    modules = {"policy": algorithm.policy, **vars(algorithm)}
    seen: set[int] = set()
    for holder, module in modules.items():
        if isinstance(module, nn.Module):
            for name, parameter in module.named_parameters():
                if id(parameter) not in seen:
                    seen.add(id(parameter))
                    yield f"the parameter {holder}.{name}", parameter
