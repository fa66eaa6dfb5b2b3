"""What the files in ``conf`` say."""

import pytest
from omegaconf import DictConfig, OmegaConf

from every_task import TASKS
from pairwise import pairwise, partly
from softgm_bench.algorithms import algorithm_configs
from softgm_bench.assembly import configure
from softgm_bench.config import compose, config_directory, plain
from softgm_bench.envs import PerturbationConfig
from softgm_bench.envs.tasks import TASK_CONFIGS
from softgm_bench.rod.randomise import FACTORS

FILES = sorted(config_directory().rglob("*.yaml"))


@pytest.mark.parametrize("file", FILES, ids=lambda file: str(file.relative_to(config_directory())))
def test_every_file_sets_a_value(file):
    settings = OmegaConf.load(file)
    assert isinstance(settings, DictConfig)
    assert set(settings) - {"defaults"}


def test_there_are_few_files_and_each_stands_in_a_group():
    assert len(FILES) <= 64
    groups = {file.relative_to(config_directory()).parts[0] for file in FILES} - {"config.yaml"}
    assert groups == {"task", "model", "algo", "experiment", "recipe", "perturbation", "randomise", "logger", "grids"}
    defaults = OmegaConf.load(config_directory() / "config.yaml").defaults
    assert all("optional" not in str(entry) and "$" not in str(entry) for entry in defaults)


@pytest.mark.parametrize("experiment", partly(["default", "quick", "smoke", "gpu"], ["default", "smoke"]))
@pytest.mark.parametrize("task", TASK_CONFIGS)
def test_every_combination_of_files_is_valid(task, experiment):
    config = configure([f"task={task}", f"experiment={experiment}", "seed=3", "device=cpu"])

    assert type(config.task) is TASK_CONFIGS[task]
    assert config.run_dir == f"outputs/{task}/softgm/seed3"


@pytest.mark.parametrize("recipe", ["paper", "tuned"])
@pytest.mark.parametrize("algo", algorithm_configs())
def test_every_algorithm_has_both_recipes(algo, recipe):
    config = configure([f"algo={algo}", f"recipe={recipe}", "task=structured"])

    assert type(config.algo) is algorithm_configs()[algo]
    assert config.algo.name == algo
    assert config.run_dir == f"outputs/structured/{algo}/seed0"
    assert config.algo.gamma == {"paper": 0.99, "tuned": 0.95}[recipe]
    assert config.model.velocity_scale == {"paper": 1.0, "tuned": 0.2}[recipe]


def test_only_the_tuned_recipe_has_what_walls_need_and_only_on_walls():
    for task in TASKS:
        for recipe in ("paper", "tuned"):
            config = compose([f"task={task}", f"recipe={recipe}"])
            assert config.task.curriculum.enabled is (recipe == "tuned" and task.startswith("wall"))
            assert config.task.hidden_scene is (task.startswith("wall") or task == "swinging_posts")
            hidden = recipe == "tuned" and config.task.hidden_scene
            assert config.algo.critic.asymmetric is hidden
            assert (config.experiment.num_envs, config.algo.minibatch_size, config.algo.gamma) == (
                ((128, 800, 0.98) if hidden else (512, 1280, 0.95)) if recipe == "tuned" else (128, 1600, 0.99)
            )


@pytest.mark.parametrize("algo", ["ippo", "mappo"])
def test_on_walls_mlps_learn_in_large_steps_and_graph_networks_in_small_ones(algo):
    for model, expected in (
        ("mlp", (512, 1280, 0.95, 0.0, False, 200, 0.6)),
        ("softgm", (128, 800, 0.98, 0.003, True, 60, 0.5)),
    ):
        config = compose(["task=wall", f"algo={algo}", f"model={model}"])
        learner, experiment = config.algo, config.experiment
        found = (experiment.num_envs, learner.minibatch_size, learner.gamma, learner.entropy_coeff)
        found += (learner.actor.embedding_norm, experiment.train_horizon, config.task.curriculum.promote)
        assert found == expected


@pytest.mark.parametrize("recipe", ["paper", "tuned"])
@pytest.mark.parametrize("algo", algorithm_configs())
def test_no_independent_critic_is_told_what_is_hidden(algo, recipe):
    critic = compose([f"algo={algo}", f"recipe={recipe}", "task=wall"]).algo.critic
    assert critic.asymmetric is (recipe == "tuned" and algo in ("softgm", "mappo", "maddpg", "masac"))


@pytest.mark.parametrize("recipe", ["paper", "tuned"])
@pytest.mark.parametrize("algo", algorithm_configs())
def test_a_smoke_run_is_small_and_takes_gradient_steps_whatever_the_recipe(algo, recipe):
    config = compose([f"algo={algo}", f"recipe={recipe}", "experiment=smoke"])
    frames = config.experiment.num_envs * config.experiment.steps_per_batch
    assert frames <= 128
    if hasattr(config.algo, "random_frames"):
        learning = config.experiment.total_frames - max(config.algo.random_frames, frames)
        assert learning * config.algo.updates_per_frame >= 2
        assert config.algo.batch_size <= frames


@pytest.mark.parametrize(
    ("task", "algo", "recipe"), pairwise(["basic", "wall"], list(algorithm_configs()), ["paper", "tuned"])
)
def test_a_gpu_run_is_valid_without_a_gpu_and_large_everywhere(task, algo, recipe):
    config = configure([f"task={task}", f"algo={algo}", f"recipe={recipe}", "experiment=gpu", "device=cpu"])
    usual = compose([f"task={task}", f"algo={algo}", f"recipe={recipe}"])

    assert (config.device, config.dtype, config.backend) == ("cpu", "float32", None)
    frames = config.experiment.num_envs * config.experiment.steps_per_batch
    if hasattr(config.algo, "updates_per_frame"):
        used, usually = (one.algo.batch_size * one.algo.updates_per_frame for one in (config, usual))
        assert frames * config.algo.updates_per_frame >= 1  # a gradient step in every iteration
        assert 0.8 < used / usually < 2.0  # as often is a frame learnt from
    else:
        assert frames % config.algo.minibatch_size == 0
        assert frames // config.algo.minibatch_size >= 4
    evaluation = config.experiment.evaluation
    steps = config.experiment.total_frames / config.experiment.num_envs  # of the simulator
    looks = config.experiment.total_frames // evaluation.interval
    assert looks * evaluation.horizon * evaluation.episodes < 0.05 * config.experiment.total_frames
    assert looks * evaluation.horizon < 0.2 * steps  # which are half of the time, and take longer


def test_only_a_gpu_run_chooses_a_gpu():
    assert (compose(["experiment=gpu"]).device, compose(["experiment=gpu"]).dtype) == ("cuda", "float32")
    for experiment in ("default", "quick", "smoke"):
        config = compose([f"experiment={experiment}"])
        assert (config.device, config.dtype) == ("cpu", "float64")


def test_softgm_is_ppo_with_the_papers_settings():
    config = compose(["recipe=paper"])
    algo, model = config.algo, config.model
    assert (algo.name, algo.centralised, algo.critic.pooling, algo.critic.asymmetric) == ("softgm", True, "mean", False)
    assert (algo.clip_epsilon, algo.gamma, algo.gae_lambda, algo.entropy_coeff) == (0.2, 0.99, 0.95, 0.05)
    assert (algo.max_grad_norm, algo.actor_lr, algo.critic_lr) == (0.5, 1e-4, 3e-4)
    assert (algo.value_norm_decay, algo.lr_schedule, algo.target_kl, algo.advantage_clip) == (
        None,
        "constant",
        None,
        None,
    )
    assert not algo.actor.state_dependent_sigma
    assert (model.hidden, model.heads, model.layers, model.type_embedding) == (128, 4, 2, 8)
    assert model.stage1
    assert model.stage2


@pytest.mark.parametrize("recipe", ["paper", "tuned"])
def test_ablations_are_softgm_but_for_their_stage(recipe):
    softgm = plain(compose([f"recipe={recipe}"]))
    for stage in (1, 2):
        name = f"softgm_no_stage{stage}"
        ablated = plain(compose([f"recipe={recipe}", f"model={name}"]))
        assert ablated["model"] == softgm["model"] | {"name": name, f"stage{stage}": False}
        assert ablated["algo"] == softgm["algo"]


def test_ippo_and_mappo_differ_from_softgm_in_model_and_critic_alone():
    softgm = plain(compose(["recipe=paper"]))["algo"]
    for name, changes in (("ippo", {"centralised": False}), ("mappo", {"critic": {"pooling": "concat"}})):
        config = compose(["recipe=paper", f"algo={name}"])
        critic = softgm["critic"] | changes.pop("critic", {})
        assert plain(config)["algo"] == softgm | {"name": name, "critic": critic} | changes
        assert type(config.model).__name__ == "MLPConfig"


def test_perturbations_are_the_papers_and_every_number_can_be_set():
    paper = [compose([f"perturbation={name}"]).perturbation for name in ("noise", "section_failure", "disturbance")]
    assert paper == [
        PerturbationConfig("noise", position_sigma=0.1, velocity_sigma=0.1, action_sigma=0.2),
        PerturbationConfig("section_failure", failed_agents=(2,)),
        PerturbationConfig("disturbance", tip_force=15.0, first_step=5, steps=6),
    ]
    config = compose(["perturbation=noise", "perturbation.position_sigma=0.05", "perturbation.failed_agents=[0,5]"])
    assert config.perturbation == PerturbationConfig("noise", 0.05, 0.1, 0.2, (0, 5))


@pytest.mark.parametrize("task", TASK_CONFIGS)
def test_bodies_of_every_range_can_be_simulated_with_the_arms_own_time_step_on_every_task(task):
    inner, outer = (configure([f"task={task}", f"randomise={name}"]).randomise for name in ("moderate", "wide"))
    assert set(inner.drawn) == set(outer.drawn) == set(FACTORS) - {"friction_coefficient"}
    for name in inner.drawn:
        low, high = getattr(outer, name)
        assert low < getattr(inner, name)[0] < 1.0 < getattr(inner, name)[1] < high
    assert compose(["randomise=wide", "randomise.density=[0.9,1.1]"]).randomise.density == (0.9, 1.1)


def test_a_training_episode_is_as_long_as_the_command_line_says_or_the_task_or_the_experiment():
    for recipe, on_wall in (("tuned", 60), ("paper", 100)):
        quick = [f"recipe={recipe}", "experiment=quick"]
        assert compose([*quick, "task=basic"]).experiment.train_horizon == 100
        assert compose([*quick, "task=wall"]).experiment.train_horizon == on_wall
        assert compose([*quick, "task=wall", "task.train_horizon=70"]).experiment.train_horizon == 70
        assert compose([*quick, "task=wall", "experiment.train_horizon=null"]).experiment.train_horizon is None


def test_the_recipe_and_the_kind_of_algorithm_say_how_many_frames_an_iteration_has():
    sizes = {
        (recipe, algo): (experiment.num_envs, experiment.steps_per_batch)
        for recipe in ("tuned", "paper")
        for algo in ("softgm", "masac")
        for experiment in [compose([f"recipe={recipe}", f"algo={algo}", "experiment=quick"]).experiment]
    }
    assert sizes == {
        ("tuned", "softgm"): (512, 25),
        ("tuned", "masac"): (256, 5),
        ("paper", "softgm"): (128, 25),
        ("paper", "masac"): (128, 10),
    }
