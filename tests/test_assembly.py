import pytest
import torch

from softgm_bench import assembly
from softgm_bench.algorithms import algorithm_configs
from softgm_bench.assembly import build_algorithm, build_env, build_policy, configure
from softgm_bench.envs import Environment, SoftArmEnv, kind_of
from softgm_bench.envs.tasks.wall import Wall
from softgm_bench.episodes import policy
from softgm_bench.errors import UserError
from softgm_bench.runs.loop import train
from softgm_bench.storage import archive
from softgm_bench.storage.run_folder import RunFolder


def shapes(module):
    return {name: value.shape for name, value in module.state_dict().items()}


@pytest.mark.parametrize("model", ["mlp", "softgm"])
@pytest.mark.parametrize("algo", algorithm_configs())
def test_a_policy_that_is_built_alone_is_the_algorithms_and_needs_no_environment(algo, model, monkeypatch):
    config = configure([f"algo={algo}", f"model={model}", "task=structured", "rod.n_elements=20"])
    env = build_env(config, 64, seed=0)
    torch.manual_seed(0)
    with_all = build_algorithm(config, env).policy
    monkeypatch.setattr(SoftArmEnv, "__init__", None)
    torch.manual_seed(0)
    alone = build_policy(config, kind_of(config.task).sizes(config.task))
    assert shapes(alone) == shapes(with_all)
    assert all(torch.equal(one, other) for one, other in zip(alone.parameters(), with_all.parameters(), strict=True))


@pytest.mark.parametrize(("task", "model"), [("basic", "mlp"), ("wall", "mlp"), ("vmas_balance", "vector_mlp")])
def test_every_environment_has_the_interface_and_the_sizes_of_its_task(task, model):
    if task.startswith("vmas"):
        pytest.importorskip("vmas", reason="VMAS is an optional extra: pip install 'softgm-bench[vmas]'")
    config = configure([f"task={task}", f"model={model}", "algo=mappo", "recipe=paper"])
    env = build_env(config, 2, seed=0)
    assert isinstance(env, Environment)
    assert env.sizes == kind_of(config.task).sizes(config.task)
    assert env.action_spec["agents", "action"].shape == (2, env.sizes.n_agents, env.sizes.action)


def test_a_checkpoint_of_before_it_held_a_policy_of_its_own_still_gives_one(tmp_path):
    for algo in ("mappo", "masac", "maddpg"):
        small = ["experiment=smoke", "threads=1", "experiment.total_frames=128", "rod.n_elements=20", "model.hidden=8"]
        train(configure([*small, f"algo={algo}", f"run_dir={tmp_path / algo}"]))
        newest = RunFolder(tmp_path / algo).newest()
        new = policy.load(newest)
        state = archive.load(newest)
        del state["policy"], state["sizes"]
        newest.write_bytes(archive.packed(state | {"format": 1}))
        old = policy.load(newest)
        assert old.sizes == new.sizes
        held = zip(old.policy.parameters(), new.policy.parameters(), strict=True)
        assert all(torch.equal(one, other) for one, other in held)


def test_a_memory_needs_an_environment_that_hands_it_on(monkeypatch):
    remembers = ["task=basic", "algo=mappo", "algo.actor.memory={cell:gru,size:8}"]
    configure(remembers)
    monkeypatch.setattr(assembly, "RememberingEnv", int)  # as if the environment were another kind's
    with pytest.raises(UserError, match=r"^algo\.actor\.memory: task=basic hands no memory on [^\n]*$"):
        configure(remembers)


def test_an_oracle_is_mirrored_only_where_its_task_says_what_mirrors_what_it_is_told(monkeypatch):
    mirrored = ["task=wall", "algo=isac", "observation=oracle", "algo.actor.mirror=canonical"]
    configure(mirrored)
    monkeypatch.setattr(Wall, "privileged_image", ())
    with pytest.raises(
        UserError, match=r"^algo\.actor\.mirror is canonical with observation=oracle: task=wall [^\n]*$"
    ):
        configure(mirrored)


@pytest.mark.parametrize("hidden", [40_000, 4 * 10**9, 4 * 10**18])  # 4e18 squared is no number of torch's
def test_a_network_that_nobody_could_mean_is_refused_before_it_takes_memory(hidden):
    with pytest.raises(UserError, match=r"^model=softgm of these sizes has more than 1,000,000,000 [^\n]*$"):
        configure(["task=wall", "algo=softgm", f"model.hidden={hidden}"])


def test_a_plain_vector_has_no_mirror_image():
    pytest.importorskip("vmas", reason="VMAS is an optional extra: pip install 'softgm-bench[vmas]'")
    vector = ["task=vmas_balance", "algo=ippo", "model=vector_mlp", "algo.actor.persistence=0"]
    configure(vector)
    with pytest.raises(UserError, match=r"^algo\.actor\.mirror is canonical[^\n]*vector.* must be null$"):
        configure([*vector, "algo.actor.mirror=canonical"])
