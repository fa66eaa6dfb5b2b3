"""GPUs of a sweep: with several of them, a cell's training sees one, the next cell's the next.

A training is shown its GPU alone (``CUDA_VISIBLE_DEVICES``), where it is ``cuda``, so that its settings are the same
whichever it was given: a cell can be resumed on another one.
"""

import os
from collections.abc import Mapping

GPUS = "SOFTGM_SWEEP_GPUS"  # environment variable: the GPUs to deal out, by the names that the next one has for them
VISIBLE = "CUDA_VISIBLE_DEVICES"


def gpus() -> list[str]:
    """Names of the GPUs that this process sees, as ``CUDA_VISIBLE_DEVICES`` has them."""
    import torch  # late: it takes seconds

    count = torch.cuda.device_count()
    named = [name for name in os.environ.get(VISIBLE, "").split(",") if name]
    return named[:count] if named else [str(index) for index in range(count)]


def dealt(device: str, number: int, environment: Mapping[str, str]) -> tuple[str, dict[str, str]]:
    """Choose the GPU of a job, round robin by its number.

    Args:
        device: that the settings name; ``cuda`` leaves the choice to us.
        number: of the job in the sweep.
        environment: of the launcher's process, with ``GPUS`` where there are several.

    Returns:
        The device as people call it, such as ``cuda:1``, and the variables that a training needs beside its own.
    """
    names = environment.get(GPUS, "").split(",")
    if device != "cuda" or len(names) < 2:
        return device, {}
    index = number % len(names)
    return f"cuda:{index}", {VISIBLE: names[index]}
