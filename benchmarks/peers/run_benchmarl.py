"""One training run with BenchMARL, in the virtual environment that ``make peers-setup`` makes."""

import math
import sys
import tempfile
import time

import torch
import yaml
from benchmarl.algorithms import algorithm_config_registry
from benchmarl.environments.vmas.common import VmasClass
from benchmarl.experiment import Callback, Experiment, ExperimentConfig
from benchmarl.models.mlp import MlpConfig
from cells import HERE, Cell, asked_for, write
from tensordict import TensorDictBase
from torch import nn
from torchrl.envs import Transform

REWARD = ("agents", "reward")


class MeanReward(Transform):
    """Gives every agent the mean of the agents' rewards."""

    def __init__(self) -> None:
        super().__init__(in_keys=[REWARD], out_keys=[REWARD])

    def _apply_transform(self, reward: torch.Tensor) -> torch.Tensor:
        return reward.mean(-2, keepdim=True).expand_as(reward).clone()


class Task(VmasClass):
    """A VMAS task with one reward for the team. On balance VMAS does that by itself."""

    def get_env_transforms(self, env):
        return [MeanReward()] if self.name == "NAVIGATION" else []


class Record(Callback):
    """Mean return of every evaluation and the seconds of collecting and learning until then."""

    def __init__(self) -> None:
        super().__init__()
        self.rows: list[tuple[int, float, float]] = []
        self.training = 0.0
        self.resumed = math.nan

    def on_train_end(self, training_td: TensorDictBase, group: str) -> None:
        now = time.perf_counter()
        self.training += now - self.resumed
        self.resumed = now

    def on_evaluation_end(self, rollouts: list[TensorDictBase]) -> None:
        # an episode's return is the sum over its steps, up to the first done, of the mean over agents
        returns = [rollout["next", REWARD].sum(0).mean() for rollout in rollouts]
        self.rows.append((self.experiment.total_frames, torch.stack(returns).mean().item(), self.training))
        self.resumed = time.perf_counter()


def make_experiment(cell: Cell, folder: str, record: Record, total_frames: int | None = None) -> Experiment:
    """An experiment as ``settings.yaml`` says."""
    settings = yaml.safe_load((HERE / "settings.yaml").read_text())
    shared, own = settings["shared"], {k: _number(v) for k, v in settings[cell.group].items()}
    config = ExperimentConfig.get_from_yaml()
    config.gamma, config.lr, config.adam_eps = shared["gamma"], own["lr"], own["adam_epsilon"]
    config.clip_grad_norm, config.clip_grad_val = True, shared["max_grad_norm"]
    config.max_n_frames = total_frames or own["total_frames"]
    config.loggers, config.create_json, config.render, config.save_folder = [], True, False, folder
    config.evaluation_interval = own["evaluation_interval"]
    config.evaluation_episodes = shared["evaluation_episodes"]
    batch = shared["num_envs"] * own["steps_per_batch"]
    algorithm = algorithm_config_registry[cell.algo].get_from_yaml()
    if cell.group == "on_policy":
        config.on_policy_n_envs_per_worker, config.on_policy_collected_frames_per_batch = shared["num_envs"], batch
        config.on_policy_n_minibatch_iters, config.on_policy_minibatch_size = own["epochs"], own["minibatch_size"]
        algorithm.clip_epsilon, algorithm.lmbda = own["clip_epsilon"], own["gae_lambda"]
        algorithm.entropy_coef, algorithm.critic_coef = own["entropy_coeff"], own["critic_coeff"]
    else:
        config.off_policy_n_envs_per_worker, config.off_policy_collected_frames_per_batch = shared["num_envs"], batch
        config.off_policy_n_optimizer_steps, config.off_policy_train_batch_size = (
            own["gradient_steps"],
            own["batch_size"],
        )
        config.off_policy_memory_size, config.polyak_tau = own["replay_capacity"], own["tau"]
        config.off_policy_init_random_frames = own["random_frames"]
        config.exploration_eps_init, config.exploration_eps_end = own["initial_sigma"], own["final_sigma"]
        config.exploration_anneal_frames = own["sigma_frames"]
        if cell.algo.endswith("sac"):
            algorithm.alpha_init = own["initial_alpha"]
    model = MlpConfig(num_cells=shared["widths"], layer_class=nn.Linear, activation_class=nn.Tanh)
    task = Task(cell.task.upper(), {"max_steps": settings["horizon"], **settings["tasks"][cell.task]})
    experiment = Experiment(task, algorithm, model, seed=cell.seed, config=config, callbacks=[record])
    draw_weights(experiment)
    return experiment


@torch.no_grad()
def draw_weights(experiment: Experiment) -> None:
    """Draw all weights as our heads do: orthogonal, gain sqrt 2, the last layer's 0.01 (actor) or 1 (critic)."""
    loss = experiment.losses["agents"]
    critic = next(name for name in ("critic_network", "qvalue_network", "value_network") if hasattr(loss, name))
    for network, last_gain in (("actor_network", 0.01), (critic, 1.0)):
        parameters = getattr(loss, f"{network}_params")
        weights = {key: value for key, value in parameters.items(True, True) if "weight" in key[-1]}
        biases = [value for key, value in parameters.items(True, True) if "bias" in key[-1]]
        for index, weight in enumerate(weights.values()):
            gain = last_gain if index == len(weights) - 1 else math.sqrt(2)
            for one in weight.data.reshape(-1, *weight.shape[-2:]):  # SAC's two critics are stacked
                nn.init.orthogonal_(one, gain)
        for bias in biases:
            bias.data.zero_()
        target = getattr(loss, f"target_{network}_params")
        if experiment.target_updaters["agents"] is not None:
            for key, value in parameters.items(True, True):
                target.get(key).data.copy_(value.data)


def _number(value):
    """YAML 1.1 takes 3e-4 for a word."""
    return float(value) if isinstance(value, str) else value


def main() -> None:
    cell, threads = asked_for("benchmarl", __doc__)
    torch.set_num_threads(threads)
    record = Record()
    with tempfile.TemporaryDirectory() as folder:
        experiment = make_experiment(cell, folder, record)
        record.resumed = time.perf_counter()
        experiment.run()
    interval = experiment.config.evaluation_interval
    write(cell, [row for row in record.rows if row[0] % interval == 0])  # one more follows the first batch


if __name__ == "__main__":
    sys.exit(main())
