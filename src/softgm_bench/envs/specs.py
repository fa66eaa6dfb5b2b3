"""The environment's TorchRL specs, made from the table of entries."""

import torch
from tensordict import NestedKey
from torchrl.data import Binary, Bounded, Composite, TensorSpec, Unbounded

from softgm_bench.envs import entries
from softgm_bench.envs.interface import Sizes

ENDS = (entries.DONE, entries.TERMINATED, entries.TRUNCATED)


def make_specs(
    num_envs: int,
    sizes: Sizes,
    device: torch.device,
    *,
    curriculum: bool = False,
    perturbed: bool = False,
    contact_limit: bool = False,
    bodies: bool = False,
) -> dict[str, TensorSpec]:
    """Make the specs of the arm's environment, each with the batch dimension, by the name of ``EnvBase``'s attribute.

    Args:
        num_envs: B.
        sizes: without privileged numbers their entry is absent.
        device: of all entries.
        curriculum: whether scenes have a difficulty; without one its entry is absent.
        contact_limit: whether contact can end an episode; without a limit its entry is absent.
        bodies: whether episodes have bodies of their own; without them their entries are absent.
        perturbed: whether the previous action that agents observe may leave its bounds.
    """
    absent = {entries.ACTION, entries.REWARD, *ENDS}
    absent |= set() if sizes.n_privileged else {entries.PRIVILEGED}
    absent |= set() if curriculum else {entries.DIFFICULTY}
    absent |= set() if contact_limit else {entries.CONTACT_FAILURE}
    absent |= set() if bodies else set(entries.BODY.values())

    def spec(key: NestedKey) -> TensorSpec:
        entry, shape = entries.TABLE[key], (num_envs, *entries.shape_of(key, sizes))
        if entry.dtype is torch.bool:
            return Binary(shape=shape, dtype=torch.bool, device=device)
        if entry.bounded and not (perturbed and key == entries.PREVIOUS_ACTION):
            return Bounded(-1.0, 1.0, shape=shape, dtype=entry.dtype, device=device)
        return Unbounded(shape=shape, dtype=entry.dtype, device=device)

    def composite(*keys: NestedKey) -> Composite:
        groups: dict[str, dict[str, TensorSpec]] = {}
        root: dict[str, TensorSpec] = {}
        for key in keys:
            if isinstance(key, str):
                root[key] = spec(key)
            else:
                groups.setdefault(key[0], {})[key[1]] = spec(key)
        for name, group in groups.items():
            root[name] = Composite(group, shape=(num_envs, *entries.group_shape(name, sizes)), device=device)
        return Composite(root, shape=(num_envs,), device=device)

    return {
        "observation_spec": composite(*(key for key in entries.TABLE if key not in absent)),
        "action_spec": composite(entries.ACTION),
        "reward_spec": spec(entries.REWARD),
        "done_spec": composite(*ENDS),
    }
