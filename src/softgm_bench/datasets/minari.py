"""Hands a data set on to Minari, Farama's format of offline data (``pip install 'minari[hdf5]'``).

Minari knows one agent with one action and one reward. Our agents act together for one reward, so the joint action
``(N, A)`` is that agent's, and what all agents observe is its observation, a dictionary of entries. Which rows belong
to which agent, the terms of the reward and the policies' names have no place there; the seeds of episodes do.
"""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from softgm_bench.datasets import layout
from softgm_bench.datasets.reading import Dataset
from softgm_bench.envs import entries
from softgm_bench.errors import UserError


def export(data: Dataset, dataset_id: str) -> Any:
    """Write a data set into Minari's folder (``MINARI_DATASETS_PATH``) and give it as Minari does.

    Args:
        data: what ``load`` gave.
        dataset_id: its name there, such as ``softgm/wall-v0``.

    Raises:
        UserError: Minari is not installed, or refuses the name.
    """
    try:
        import minari
        from gymnasium import spaces
        from minari.data_collector import EpisodeBuffer
    except ImportError as error:
        raise UserError(f"{error.name} is not installed: pip install 'minari[hdf5]' gymnasium") from error
    episodes, storage = data.episodes, data.storage()
    ends = np.cumsum(episodes["length"])
    buffers, observation, action = [], spaces.Dict({}), None
    for number, (end, length) in enumerate(zip(ends.tolist(), episodes["length"].tolist(), strict=True)):
        steps = storage[slice(end - length, end)]
        shown = {
            "_".join([key] if isinstance(key, str) else key): _numbers(torch.cat([value, steps["next", key][-1:]]))
            for key, value in steps.items(include_nested=True, leaves_only=True)
            if key[0] != "next" and key not in (entries.ACTION, layout.EPISODE, layout.POLICY) and value.numel()
        }
        if action is None:
            observation = spaces.Dict({name: _space(spaces, values) for name, values in shown.items()})
            action = spaces.Box(-1.0, 1.0, steps[entries.ACTION].shape[1:], np.float32)
        buffers.append(
            EpisodeBuffer(
                id=number,
                seed=int(episodes["seed"][number]),
                options={name: int(episodes[name][number]) for name in ("policy", "part", "environment")},
                observations=shown,
                actions=steps[entries.ACTION].numpy(),
                rewards=steps["next", entries.REWARD].squeeze(-1).numpy(),
                terminations=steps["next", entries.TERMINATED].squeeze(-1).numpy(),
                truncations=steps["next", entries.TRUNCATED].squeeze(-1).numpy(),
                infos={},
            )
        )
    told = {"author": data.settings["author"], "description": f"softgm_bench, task {data.settings['task']}"}
    try:
        return minari.create_dataset_from_buffers(
            dataset_id, buffers, action_space=action, observation_space=observation, data_format="hdf5", **told
        )
    except ValueError as error:
        raise UserError(f"{dataset_id}: {error}") from error


def _space(spaces: Any, values: NDArray[Any]) -> Any:
    """Give the space of an entry ``(steps, ...)``: flags are 0 or 1, other numbers any."""
    low, high = (0, 1) if values.dtype == np.uint8 else (-np.inf, np.inf)
    return spaces.Box(low, high, values.shape[1:], dtype=values.dtype)


def _numbers(values: Tensor) -> NDArray[Any]:
    """Give an entry's values; flags as 0 and 1, since TorchRL's reader of Minari knows no flags."""
    return (values.to(torch.uint8) if values.dtype is torch.bool else values).numpy()
