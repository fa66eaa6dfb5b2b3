import dataclasses

import pytest
import torch
import yaml
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from softgm_bench.algorithms import algorithm_configs
from softgm_bench.config import UserError, compose, compose_untyped, config_directory, dtype_of, plain, typed
from softgm_bench.config.explain import USER_ERRORS, explain
from softgm_bench.envs import PerturbationConfig, make_env
from softgm_bench.envs.tasks import TASK_CONFIGS
from softgm_bench.rod.numba_backend import NumbaBackend
from softgm_bench.rod.parameters import RodParameters


def refusal(*overrides):
    """The line that these overrides are answered with."""
    with pytest.raises(USER_ERRORS) as caught:
        compose(list(overrides))
    line = explain(caught.value, list(overrides))
    assert "\n" not in line
    return line


@pytest.mark.parametrize("experiment", ["default", "quick", "smoke"])
@pytest.mark.parametrize("task", TASK_CONFIGS)
def test_every_combination_of_files_is_valid(task, experiment):
    config = compose([f"task={task}", f"experiment={experiment}", "seed=3"])

    assert type(config.task) is TASK_CONFIGS[task]
    assert config.run_dir == f"outputs/{task}/softgm/seed3"


@pytest.mark.parametrize("recipe", ["paper", "open"])
@pytest.mark.parametrize("algo", algorithm_configs())
def test_every_algorithm_has_both_recipes(algo, recipe):
    config = compose([f"algo={algo}", f"recipe={recipe}", "task=wall"])

    assert type(config.algo) is algorithm_configs()[algo]
    assert config.algo.name == algo
    assert config.run_dir == f"outputs/wall/{algo}/seed0"
    assert config.algo.gamma == {"paper": 0.99, "open": 0.95}[recipe]
    assert config.model.velocity_scale == {"paper": 1.0, "open": 0.2}[recipe]


def test_only_the_open_recipe_has_what_walls_need_and_only_on_walls():
    for task in ("basic", "structured", "wall", "wall_narrow", "wall_fixed"):
        for recipe in ("paper", "open"):
            config = compose([f"task={task}", f"recipe={recipe}"])
            expected = recipe == "open" and task.startswith("wall")
            assert config.task.curriculum.enabled is config.algo.critic.asymmetric is expected


def test_what_the_command_line_says_comes_after_the_recipe_and_the_recipe_after_the_experiment():
    overrides = ["algo=masac", "experiment=quick", "recipe=open"]
    assert (
        compose(overrides).experiment.steps_per_batch
        == compose(["algo=masac", "recipe=open"]).experiment.steps_per_batch
    )
    assert compose([*overrides, "experiment.steps_per_batch=7", "algo.gamma=0.9"]).experiment.steps_per_batch == 7
    assert compose([*overrides, "algo.gamma=0.9"]).algo.gamma == 0.9


@pytest.mark.parametrize("recipe", ["paper", "open"])
@pytest.mark.parametrize("algo", algorithm_configs())
def test_a_smoke_run_is_small_and_takes_gradient_steps_whatever_the_recipe(algo, recipe):
    config = compose([f"algo={algo}", f"recipe={recipe}", "experiment=smoke"])
    frames = config.experiment.num_envs * config.experiment.steps_per_batch
    assert frames <= 128
    if hasattr(config.algo, "random_frames"):
        learning = config.experiment.total_frames - max(config.algo.random_frames, frames)
        assert learning * config.algo.updates_per_frame >= 2
        assert config.algo.batch_size <= frames


def test_softgm_is_ppo_with_the_papers_settings():
    config = compose([])
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


def test_ablations_are_softgm_but_for_their_stage():
    softgm = plain(compose([]))
    for stage in (1, 2):
        ablated = plain(compose([f"algo=softgm_no_stage{stage}"]))
        assert ablated["model"] == softgm["model"] | {f"stage{stage}": False}
        assert ablated["algo"] == softgm["algo"] | {"name": f"softgm_no_stage{stage}"}


def test_ippo_and_mappo_differ_from_softgm_in_model_and_critic_alone():
    softgm = plain(compose([]))["algo"]
    for name, changes in (("ippo", {"centralised": False}), ("mappo", {"critic": {"pooling": "concat"}})):
        config = compose([f"algo={name}"])
        critic = softgm["critic"] | changes.pop("critic", {})
        assert plain(config)["algo"] == softgm | {"name": name, "critic": critic} | changes
        assert type(config.model).__name__ == "MLPConfig"


def test_a_linear_schedule_lasts_as_long_as_the_run_unless_told_otherwise():
    assert compose(["experiment.total_frames=777"]).algo.lr_schedule_frames == 777
    assert compose(["algo.lr_schedule_frames=5"]).algo.lr_schedule_frames == 5
    refused = "algo.lr_schedule_frames is 0: it must be at least 1"
    assert refusal("algo.lr_schedule=linear", "algo.lr_schedule_frames=0") == refused


def test_another_model_than_an_algorithms_own_is_named_in_folder_and_label():
    for algo, model, name in (
        ("softgm", "softgm", "softgm"),
        ("softgm_no_stage1", "softgm", "softgm_no_stage1"),
        ("softgm", "mlp", "softgm_mlp"),
        ("masac", "mlp", "masac"),
        ("masac", "softgm", "masac_softgm"),
    ):
        config = compose([f"algo={algo}", f"model={model}"])
        assert config.label == name
        assert config.run_dir == f"outputs/basic/{name}/seed0"


def test_an_oracle_says_so_wherever_its_results_go():
    assert compose(["observation=oracle", "algo=ippo"]).run_dir == "outputs/basic/ippo_oracle/seed0"
    assert compose(["observation=oracle", "algo=ippo"]).label == "ippo_oracle"
    assert compose(["observation=oracle", "run_dir=here/oracle"]).oracle
    assert refusal("observation=oracle", "run_dir=here").startswith(
        "run_dir=here with observation=oracle: put the word"
    )
    assert not compose([]).oracle


def test_what_was_trained_under_a_perturbation_says_so_wherever_its_results_go():
    for name in ("noise", "section_failure", "disturbance"):
        config = compose([f"perturbation={name}", "algo=masac"])
        assert config.label == f"masac_{name}"
        assert config.run_dir == f"outputs/basic/masac_{name}/seed0"
        assert not config.perturbation.nothing
    assert compose(["perturbation=noise", "perturbation.name=fog"]).label == "softgm_fog"
    assert compose([]).perturbation == PerturbationConfig()


def test_perturbations_are_the_papers_and_every_number_can_be_set():
    paper = [compose([f"perturbation={name}"]).perturbation for name in ("noise", "section_failure", "disturbance")]
    assert paper == [
        PerturbationConfig("noise", position_sigma=0.1, velocity_sigma=0.1, action_sigma=0.2),
        PerturbationConfig("section_failure", failed_agents=(2,)),
        PerturbationConfig("disturbance", tip_force=15.0, first_step=5, steps=6),
    ]
    config = compose(["perturbation=noise", "perturbation.position_sigma=0.05", "perturbation.failed_agents=[0,5]"])
    assert config.perturbation == PerturbationConfig("noise", 0.05, 0.1, 0.2, (0, 5))


def test_mistakes_in_perturbations_are_one_line():
    assert refusal("perturbation=nois").startswith("perturbation=nois: no such perturbation; choose one of disturbance")
    assert refusal("perturbation.sigma=1").startswith("perturbation.sigma: no such key; did you mean perturbation.")
    assert refusal("perturbation.position_sigma=1").startswith("perturbation.position_sigma is 1.0 with perturbation=")
    absent = refusal("perturbation=section_failure", "perturbation.failed_agents=[7]")
    assert absent == "perturbation.failed_agents holds 7: the 6 agents are 0 to 5"
    vmas = refusal("perturbation=noise", "task=vmas_balance", "model=vector_mlp")
    assert vmas == "perturbation=noise: task=vmas_balance has no arm; it must be none"


def test_runs_from_before_there_were_perturbations_had_none():
    values = plain(compose([]))
    del values["perturbation"]
    assert typed(OmegaConf.create(values)) == compose([])


def test_the_arm_is_its_dataclass_unless_told_otherwise():
    assert compose([]).rod == RodParameters()
    assert compose(["rod.gravity=[0,0,-9.81]"]).rod == RodParameters(gravity=(0.0, 0.0, -9.81))
    hash(compose([]).rod)


def test_a_model_can_be_chosen_against_the_algorithms_own():
    assert type(compose([]).model).__name__ == "SoftGMConfig"
    assert type(compose(["model=mlp"]).model).__name__ == "MLPConfig"


@pytest.mark.parametrize("algo", algorithm_configs())
def test_plain_values_give_the_same_configuration_back(algo):
    config = compose(["task=wall_narrow", f"algo={algo}"])

    assert typed(OmegaConf.create(yaml.safe_load(yaml.safe_dump(plain_lists(plain(config)))))) == config


def plain_lists(value):
    if isinstance(value, dict):
        return {key: plain_lists(item) for key, item in value.items()}
    return [plain_lists(item) for item in value] if isinstance(value, tuple) else value


@pytest.mark.parametrize("algo", ["softgm", "iddpg", "isac"])
def test_dataclasses_carry_no_values_of_their_own_but_the_arms(algo):
    config = compose([f"algo={algo}"])
    parts = (config, config.experiment, config.experiment.evaluation, config.task, config.algo, config.model)
    parts += (config.algo.actor, config.algo.critic)
    for part in parts:
        fields = dataclasses.fields(part)
        assert all(field.default is field.default_factory is dataclasses.MISSING for field in fields), type(part)


def test_keys_that_nobody_reads_are_refused_wherever_they_are_written():
    assert refusal("seeed=1") == "seeed: no such key; did you mean seed?"
    assert refusal("+task.horizn=1") == "task.horizn: no such key; did you mean task.horizon?"
    assert refusal("num_envs=1") == "num_envs: no such key; did you mean experiment.num_envs?"
    assert refusal("task=wall", "task.opening_sid=1") == (
        "task.opening_sid: no such key; did you mean task.opening_side?"
    )
    assert refusal("algo.xyzzyx=1") == "algo.xyzzyx: no such key; --cfg job lists every key"


def test_values_of_the_wrong_type_are_refused():
    for override in ("seed=1.5", "seed=true", "overwrite=maybe", "experiment.evaluation.episodes=[1]", "rod.dt=fast"):
        assert refusal(override).startswith(override.partition("=")[0] + ": ")


def test_unknown_choices_list_the_known_ones():
    tasks = "basic, structured, vmas_balance, vmas_navigation, wall, wall_fixed, wall_narrow"
    assert refusal("task=wal") == f"task=wal: no such task; choose one of {tasks}"
    assert refusal("experiment=fast") == "experiment=fast: no such experiment; choose one of default, quick, smoke"
    assert refusal("model=cnn") == "model=cnn: no such model; choose one of mlp, softgm, vector_mlp"
    algorithms = ", ".join(sorted(algorithm_configs()))
    assert refusal("algo=ppo") == f"algo=ppo: no such algo; choose one of {algorithms}"
    assert refusal("recipe=best") == "recipe=best: no such recipe; choose one of open, paper"
    assert refusal("task=common").startswith("task=common: no such task; choose one of basic, ")


@pytest.mark.parametrize(
    "override",
    [
        "seed=-1",
        "threads=0",
        "threads=100000",
        "device=gpu",
        "device=cuda",
        "backend=jax",
        "dtype=float16",
        "run_dir=''",
        "experiment.total_frames=0",
        "experiment.num_envs=-2",
        "experiment.steps_per_batch=0",
        "experiment.train_horizon=0",
        "experiment.evaluation.interval=0",
        "experiment.evaluation.episodes=0",
        "experiment.evaluation.final_episodes=0",
        "experiment.evaluation.horizon=0",
        "experiment.evaluation.final_horizon=0",
        "experiment.checkpoint.interval=0",
        "experiment.checkpoint.keep=0",
        "rod.n_elements=1",
        "task.n_agents=0",
        "task.horizon=0",
        "task.success_radius=0.0",
        "task.min_dilatation=1.5",
        "task.actuation.basis=linear",
        "task.actuation.scaling=total",
        "observation=all",
        "algo.epochs=0",
        "algo.minibatch_size=0",
        "algo.gamma=1.5",
        "algo.actor_lr=0.0",
        "algo.entropy_coeff=-1.0",
        "algo.lr_schedule=cosine",
        "algo.value_norm_decay=1.0",
        "algo.critic.pooling=max",
        "algo.actor.initial_sigma=9.0",
        "algo.actor.persistence=1.0",
    ],
)
def test_values_without_sense_are_refused_by_name(override):
    key, _, value = override.partition("=")

    with pytest.raises(UserError) as caught:
        compose([override])

    assert str(caught.value).startswith(key)
    assert value.strip("'") in str(caught.value)


def test_a_backend_and_a_device_that_do_not_fit_are_refused_in_one_line():
    assert "backend=numba" in refusal("device=cuda", "backend=numba")
    assert "choose backend=cuda" in refusal("device=cuda", "backend=numba")
    assert "device=cuda" in refusal("backend=cuda")


def test_the_backend_is_the_devices_fused_kernel_unless_one_is_named_and_the_precision_is_the_rods():
    config = compose(["dtype=float32"])
    assert config.backend is None
    env = make_env(config.task, config.rod, 1, 0, dtype=dtype_of(config))
    assert isinstance(env.backend, NumbaBackend)
    assert env.simulation_state()["episodes", "rod", "position"].dtype == torch.float32
    assert env.reset()["tip"].dtype == torch.float32
    assert dtype_of(compose([])) == torch.float64


def test_what_only_building_the_environment_or_the_model_can_refuse_is_refused_with_the_rest():
    for overrides, message in (
        (["task=wall", "task.max_path=0.1"], "no admissible pair of opening and target"),
        (["task=wall", "task.opening_side=2.0"], "task.opening_z"),
        (["model.heads=3"], "heads=3"),
    ):
        with pytest.raises(UserError, match=message):
            compose(overrides)


def test_unreadable_and_dangling_overrides_are_one_line():
    assert refusal("seed").endswith("settings are written key=value")
    assert refusal("run_dir=${nowhere}").startswith("run_dir: ")


def test_the_configuration_directory_is_the_repositorys():
    assert (config_directory() / "config.yaml").is_file()
    assert isinstance(compose_untyped([]).seed, int)


def test_errors_of_this_program_are_not_taken_for_the_users():
    assert not issubclass(KeyError, USER_ERRORS)
    assert not issubclass(ValueError, USER_ERRORS)
    assert {HydraException, OmegaConfBaseException, OSError, UserError} == set(USER_ERRORS)
