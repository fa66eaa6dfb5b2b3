"""The environment that a configuration means."""

from softgm_bench.config import Config, dtype_of
from softgm_bench.envs import SoftArmEnv, make_env
from softgm_bench.envs.vmas import VmasConfig, VmasEnv


def build_env(
    config: Config, num_envs: int, seed: int, horizon: int | None = None, training: bool = False
) -> SoftArmEnv | VmasEnv:
    """``num_envs`` environments of a checked configuration.

    Args:
        config: of which task, arm, device, backend, precision and perturbation count.
        num_envs: simulated at once.
        seed: of everything that the environments draw.
        horizon: control steps of an episode; None: the task's own.
        training: staggered clocks and, if it is enabled, the curriculum.
    """
    if isinstance(config.task, VmasConfig):
        return VmasEnv(config.task, num_envs, seed, horizon)
    return make_env(
        config.task,
        config.rod,
        num_envs=num_envs,
        seed=seed,
        horizon=horizon,
        device=config.device,
        backend=config.backend,
        dtype=dtype_of(config),
        stagger=training,
        curriculum=training,
        perturbation=config.perturbation,
    )
