"""A control step to be judged, of one environment whose tip is at its target."""

import torch

from softgm_bench.envs.verdict import Step


def one_step(contact_steps: int, touching: bool, pushed: bool = False) -> Step:
    """The arm is at rest with its tip at the target, and touches with one node or none, and was pushed or not."""
    still, never, once = torch.zeros(1, 3, 5), torch.zeros(1, dtype=torch.bool), torch.ones(1, dtype=torch.int64)
    contact = torch.zeros(1, 5, dtype=torch.bool)
    contact[:, 2] = touching
    action = torch.zeros(1, 4, 2)
    return Step(
        before=still,
        after=still,
        target=still[..., 0],
        action=action,
        previous_action=action,
        touching=contact,
        pushed=torch.tensor([pushed]),
        new_bins=0 * once,
        broken=never,
        terminated=never,
        truncated=never,
        steps=once,
        contact_steps=contact_steps * once,
    )
