from made_up_runs import write_run
from softgm_bench.analysis.marl_eval import export
from softgm_bench.analysis.runs import find


def test_the_export_has_the_layout_that_marl_eval_reads(tmp_path):
    for label in ("softgm", "mappo"):
        for seed in range(2):
            write_run(tmp_path, "basic", label, seed, count=30, points=12)
    runs = find(tmp_path).runs
    exported = export(runs)
    assert list(exported) == ["softgm_bench"]
    assert list(exported["softgm_bench"]) == ["basic"]
    assert list(exported["softgm_bench"]["basic"]) == ["MAPPO", "SOFTGM"]
    run = exported["softgm_bench"]["basic"]["SOFTGM"]["seed_1"]
    assert list(run) == [*(f"step_{index}" for index in range(12)), "absolute_metrics"]
    (source,) = [one for one in runs if one.final.label == "softgm" and one.final.seed == 1]
    for index, evaluation in enumerate(source.progress):
        entry = run[f"step_{index}"]
        assert entry["step_count"] == evaluation["frames"]
        assert entry["return"] == [evaluation["discounted_return"]["mean"]]
    final = run["absolute_metrics"]
    assert set(final) == {"return", "success_rate", "episode_length"}
    assert final["success_rate"] == source.final.episodes["success"].tolist()
    assert len(final["return"]) == 30
