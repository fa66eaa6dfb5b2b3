import re

import pytest
from refused import refusal

from softgm_bench.assembly import configure
from softgm_bench.config import compose, validate
from softgm_bench.errors import UserError


def test_mistakes_in_perturbations_are_one_line():
    assert refusal("perturbation=nois").startswith("perturbation=nois: no such perturbation; choose one of disturbance")
    assert refusal("perturbation.sigma=1").startswith("perturbation.sigma: no such key; did you mean perturbation.")
    assert refusal("perturbation.position_sigma=1").startswith("perturbation.position_sigma is 1.0 with perturbation=")
    absent = refusal("perturbation=section_failure", "perturbation.failed_agents=[7]")
    assert absent == "perturbation.failed_agents holds 7: the 6 agents are 0 to 5"
    vmas = refusal("perturbation=noise", "task=vmas_balance", "model=vector_mlp")
    assert vmas == "perturbation=noise: task=vmas_balance has no arm; it must be none"


def test_mistakes_in_bodies_are_one_line():
    assert refusal("randomise=wid").startswith("randomise=wid: no such randomise; choose one of moderate, none, wide")
    assert refusal("randomise.mass=[1,2]").startswith("randomise.mass: no such key; did you mean randomise.")
    assert refusal("randomise.density=[0.9,1.1]").startswith("randomise.density is [0.9, 1.1] with randomise=none: ")
    assert refusal("randomise=wide", "randomise.density=[1.1,0.9]").startswith(
        "randomise.density=[1.1, 0.9]: the lower end of a range comes first"
    )
    assert refusal("randomise=wide", "randomise.density=[1.0]").endswith("it must be a range, [low, high]")
    torn = refusal("randomise=wide", "randomise.youngs_modulus=[0.5,4]")
    assert torn.startswith("randomise.youngs_modulus=[0.5,4] randomise.density=[0.8,1.25]")
    assert re.search(r"narrow them or give rod\.dt=\S+ rod\.substeps=\d+$", torn)
    rough = refusal("randomise=wide", "randomise.friction_coefficient=[0.5,2]", "task=wall")
    assert rough.startswith("randomise.friction_coefficient=[0.5,2]: the nominal arm has no friction to multiply")
    vmas = refusal("randomise=wide", "task=vmas_balance", "model=vector_mlp")
    assert vmas == "randomise=wide: task=vmas_balance has no arm; it must be none"


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
        "compile=inductor",
        "compile=graph",
        "matmul=fp8",
        "matmul=tf32",
        "run_dir=''",
        "start.critic_frames=-1",
        "experiment.total_frames=0",
        "experiment.num_envs=-2",
        "experiment.steps_per_batch=0",
        "experiment.train_horizon=0",
        "task.train_horizon=0",
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
        configure([override])

    assert str(caught.value).startswith(key)
    assert value.strip("'") in str(caught.value)


def test_a_backend_and_a_device_that_do_not_fit_are_refused_in_one_line():
    assert "backend=numba" in refusal("device=cuda", "backend=numba")
    assert refusal("device=cuda", "backend=numba").endswith("choose device=cpu, or backend=torch or cuda")
    assert "device=cuda" in refusal("backend=cuda")


def test_what_only_building_can_refuse_is_refused_with_the_rest_and_not_by_composing():
    for overrides, message in (
        (["task=wall", "task.max_path=0.1"], "no admissible pair of opening and target"),
        (["task=wall", "task.opening_side=2.0"], "task.opening_z"),
        (["model.heads=3"], "heads=3"),
    ):
        with pytest.raises(UserError, match=message):
            configure(overrides)
        validate(compose(overrides))


def test_tasks_without_an_arm_need_the_papers_recipe_and_say_so_by_the_first_setting_that_does_not_fit():
    pytest.importorskip("vmas", reason="VMAS is an optional extra: pip install 'softgm-bench[vmas]'")
    vmas = ("task=vmas_balance", "algo=mappo", "model=vector_mlp")
    assert refusal(*vmas).startswith("algo.actor.persistence is 0.5: task=vmas_balance does not show")
    assert configure([*vmas, "recipe=paper"]).experiment.train_horizon == 200


def test_graphs_are_by_device_and_refused_without_one_in_a_line():
    assert not compose([]).graphs
    assert compose(["device=cuda"]).graphs
    assert not compose(["device=cuda", "compile=none"]).graphs
    assert refusal("compile=graph") == (
        "compile=graph with device=cpu: CUDA graphs need device=cuda; choose none or null"
    )
