"""An episode without a simulation: an arm bends from straight to a quarter of a circle towards +x, past two posts."""

import numpy as np

from softgm_bench.config import compose, plain
from softgm_bench.episodes.trajectory import Trajectory

STEPS, N, M = 6, 6, 4  # control steps, agents, slots
POST_X, POST_RADIUS = 0.35, 0.05


def bending_arm(success: bool = True, posts: bool = True, attention: bool = True) -> Trajectory:
    """The target is at the last state's tip; bin k of the first post is discovered at step k, for k below 3."""
    config = plain(compose(["task=structured", f"task.slots={M}"]))
    n = config["rod"]["n_elements"]
    arc = np.linspace(0.0, 1.0, n + 1)
    bend = np.linspace(1e-6, 0.5 * np.pi, STEPS + 1)[:, None]
    x, z = (1.0 - np.cos(bend * arc)) / bend, np.sin(bend * arc) / bend
    position = np.stack([x, np.zeros_like(x), z], axis=1)
    tangent = np.diff(position, axis=-1)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    d1 = np.zeros_like(tangent)
    d1[:, 1] = 1.0
    count = 2 if posts else 0
    start = np.array([[POST_X, -0.2, -0.2], [POST_X, 0.2, -0.2]])[:count]
    middle = 0.05 * np.arange(M) + 0.025
    descriptor = np.zeros((STEPS + 1, M, 9))
    descriptor[..., :3] = np.stack([np.full(M, POST_X), np.full(M, -0.2), middle - 0.2], axis=-1)
    active = posts & (np.arange(M) < 3) & (np.arange(STEPS + 1)[:, None] >= np.arange(M))
    stage1 = np.zeros((STEPS, 1, 2, N, N + M), dtype=np.float32)
    stage1[..., :N] = np.eye(N)
    stage1[:, :, 0, 4, N] = 1.0  # one of two heads of agent 4 looks at the first bin
    return Trajectory(
        position=position,
        director=np.stack([d1, np.cross(tangent, d1, axis=1), tangent], axis=1),
        velocity=np.gradient(position, 0.04, axis=0),
        omega=np.zeros((STEPS + 1, 3, n)),
        contact=np.zeros((STEPS + 1, n + 1), dtype=bool),
        action=np.zeros((STEPS, N, 2), dtype=np.float32),
        tip_force=np.zeros((STEPS, 3)),
        reward=np.zeros(STEPS, dtype=np.float32),
        target=position[-1, :, -1].copy(),
        observation={"slots/descriptor": descriptor.astype(np.float32), "slots/active": active}
        | {"agents/edge": np.zeros((STEPS + 1, N, M), dtype=bool)},
        reward_terms={"distance": np.zeros(STEPS, dtype=np.float32)},
        cylinders={
            "start": start,
            "axis": np.tile([0.0, 0.0, 1.0], (count, 1)),
            "length": np.full(count, 1.2),
            "radius": np.full(count, POST_RADIUS),
        },
        attention={"stage1": stage1} if attention else {},
        success=success,
        diverged=False,
        config=config,
        info={"label": "none", "task": "structured", "seed": 0, "episode": 0, "episodes": 1},
    )
