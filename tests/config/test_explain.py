from hydra.errors import HydraException
from omegaconf.errors import OmegaConfBaseException
from refused import refusal

from softgm_bench.algorithms import algorithm_configs
from softgm_bench.config.explain import USER_ERRORS
from softgm_bench.errors import UserError


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
    walls = "wall, wall_decoy, wall_fixed, wall_narrow, wall_search, wall_sense, wall_sliding, wall_touch"
    tasks = f"basic, structured, swinging_posts, vmas_balance, vmas_navigation, {walls}"
    assert refusal("task=wal") == f"task=wal: no such task; choose one of {tasks}"
    assert refusal("experiment=fast") == "experiment=fast: no such experiment; choose one of default, gpu, quick, smoke"
    transformers = "section_transformer, section_transformer_all, section_transformer_remember"
    softgm = "softgm, softgm_no_stage1, softgm_no_stage2, softgm_remember"
    models = f"informarl, informarl_remember, mlp, {transformers}, {softgm}, vector_mlp"
    assert refusal("model=cnn") == f"model=cnn: no such model; choose one of {models}"
    algorithms = ", ".join(sorted(algorithm_configs()))
    assert refusal("algo=ppo") == f"algo=ppo: no such algo; choose one of {algorithms}"
    assert refusal("recipe=best") == "recipe=best: no such recipe; choose one of paper, tuned"
    assert refusal("task=common").startswith("task=common: no such task; choose one of basic, ")


def test_unreadable_and_dangling_overrides_are_one_line():
    assert refusal("seed").endswith("settings are written key=value")
    assert refusal("run_dir=${nowhere}").startswith("run_dir: ")


def test_errors_of_this_program_are_not_taken_for_the_users():
    assert not issubclass(KeyError, USER_ERRORS)
    assert not issubclass(ValueError, USER_ERRORS)
    assert {HydraException, OmegaConfBaseException, OSError, UserError} == set(USER_ERRORS)
