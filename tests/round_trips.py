"""Finding, without a GPU, the operations at which a program would wait for one."""

import traceback
from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode

# What reads values, or has a shape that depends on them; and tensors made of Python numbers, which are copied over.
WAITS = (
    "_local_scalar_dense",
    "is_nonzero",
    "equal",
    "nonzero",
    "nonzero_static",
    "masked_select",
    "unique_dim",
    "_unique",
    "_unique2",
    "unique_consecutive",
    "bincount",
    "lift_fresh",
    "lift_fresh_copy",
)
INSIDE = ("_compile.py", "eval_frame.py", "_python_dispatch.py")  # files of torch between an operation and its caller
MASKABLE = ("index", "index_put", "index_put_", "_index_put_impl_")


class RoundTrips(TorchDispatchMode):
    """Notes every such operation; ``found`` holds one line for each, with the innermost place in this repository.

    Reads of tensors in ``exempt`` (those that live on the CPU whatever the device) are left out.
    """

    def __init__(self, exempt: tuple[torch.Tensor, ...] = ()) -> None:
        super().__init__()
        self.found: list[str] = []
        self._exempt = {id(tensor) for tensor in exempt}

    def __torch_dispatch__(self, func, types, args=(), kwargs=None) -> Any:
        name = func.overloadpacket.__name__
        masks = name in MASKABLE and any(t is not None and t.dtype in (torch.bool, torch.uint8) for t in args[1])
        if masks and name != "index":  # a mask that takes one number is filled, not searched
            masks = args[2].numel() > 1
        if (name in WAITS or masks) and not (args and id(args[0]) in self._exempt):
            self.found.append(f"{name} at {_place()}")
        return func(*args, **(kwargs or {}))


def _place() -> str:
    frames = [frame for frame in traceback.extract_stack()[:-2] if not frame.filename.endswith(INSIDE)]
    ours = [frame for frame in frames if "softgm_bench" in frame.filename]
    return ", called from ".join(
        f"{frame.filename.rsplit('/', 1)[1]}:{frame.lineno}" for frame in (frames[-1], *ours[-1:])
    )
