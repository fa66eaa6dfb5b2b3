"""A short video of the final policy."""

import importlib.util

import torch
from tensordict.nn import TensorDictModuleBase

from softgm_bench.config import Config
from softgm_bench.envs import Sizes, kind_of
from softgm_bench.envs.section_mixture import members
from softgm_bench.episodes.policy import TrainedPolicy
from softgm_bench.episodes.recording import record
from softgm_bench.storage.versions import versions

WIDTH, HEIGHT, FPS, LONGEST = 480, 360, 15, 400  # pixels, frames a second of video, control steps


def episode_video(config: Config, policy: TensorDictModuleBase, sizes: Sizes, frames: int) -> bytes | None:
    """An MP4 of an evaluation's first episode, or of its first ``LONGEST`` steps.

    None where there is no arm to be drawn, or without the extra ``render``.
    """
    if not kind_of(config.task).has_arm or not all(map(importlib.util.find_spec, ("av", "PIL"))):
        return None
    from softgm_bench.render import video  # late: drawing is an extra
    from softgm_bench.render.still import PictureSettings, Studio

    config = next(iter(members(config).values()), config)  # of a mixture the first
    settings = config.experiment.evaluation
    horizon = min(settings.final_horizon or config.task.horizon, LONGEST)
    trained = TrainedPolicy(policy, sizes, config, frames, versions(), config)
    episode = record(trained, config.seed, horizon=horizon, deterministic=settings.deterministic)
    studio = Studio(episode, PictureSettings(width=WIDTH, height=HEIGHT, text=True))
    control_dt = studio.stage.control_dt
    speed = video.natural_speed(episode.steps * control_dt)
    times = video.moments(episode.steps, control_dt, FPS, speed)
    return video.mp4(video.pictures(studio, times, speed, torch.get_num_threads()), FPS)
