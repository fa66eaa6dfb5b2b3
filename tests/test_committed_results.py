import csv
import itertools
import json
import re
import shlex
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from torchrl.envs.utils import ExplorationType, set_exploration_type

from committed import ROOT, script
from softgm_bench.analysis.statistics import mcnemar
from softgm_bench.config import compose
from softgm_bench.envs import entries, make_env
from softgm_bench.episodes import policy
from softgm_bench.rod.actuation import Actuation

POLICIES = sorted((ROOT / "experiments" / "policies").glob("*.pt"))


@pytest.fixture(scope="module")
def results():
    return script(ROOT / "experiments" / "results.py")


def test_the_comparison_with_benchmarl_is_whole_and_its_table_made_from_the_committed_runs(monkeypatch):
    peers = ROOT / "benchmarks" / "peers"
    monkeypatch.syspath_prepend(peers)
    report = script(peers / "report.py")
    curves, rates = report.read()
    for framework, task, algo in itertools.product(report.FRAMEWORKS, report.TASKS, report.ALGORITHMS):
        frames, returns = curves[framework, task, algo]
        assert returns.shape == (3, len(frames))
    text = report.PAGE.read_text()
    assert report.page(text, report.table(curves, rates)) == text


def test_the_tables_of_the_results_are_made_from_the_committed_runs(results):
    page = results.PAGE.read_text()
    assert results.page(page) == page
    assert any(results.runs(task) for task in results.TASKS)


@pytest.fixture(scope="module")
def campaign():
    return script(ROOT / "experiments" / "campaign.py")


def test_every_run_of_the_campaign_is_a_cell_at_its_budget_and_the_page_names_what_is_missing(campaign):
    page = campaign.PAGE.read_text()
    assert campaign.page(page) == page
    wanted = {cell for grid in campaign.GRIDS for cell in campaign.cells(grid)}
    missing = wanted - set(campaign.runs())
    table = page.partition("<!-- campaign cells -->")[2].partition("<!-- end -->")[0]
    assert table.count(campaign.MISSING) == len(missing)
    assert f"{len(wanted) - len(missing)} of {len(wanted)} cells are there" in table


def test_perturbed_and_nominal_episodes_are_of_one_policy_and_differ_in_the_perturbation_alone(campaign):
    folders = list(campaign.CAMPAIGN.glob("*/*/*/robustness"))
    assert folders
    for folder in folders:
        played = [json.loads((folder / name / "summary.json").read_text()) for name in campaign.CONDITIONS.values()]
        names = [summary.pop("perturbation", {"name": "none"})["name"] for summary in played]
        assert names == list(campaign.CONDITIONS.values())
        for summary in played:
            assert summary.pop("metrics")["episodes"] == 1000
            summary.pop("overrides")
            assert summary == played[0]
        assert played[0]["policy"] == policy.fingerprint(policy.load(folder.with_name("policy.pt")))
        assert (played[0]["horizon"], played[0]["intervention"]) == (2000, "none")


def test_what_perturbations_are_said_to_cost_is_what_the_committed_episodes_hold(campaign):
    page, told = " ".join(campaign.PAGE.read_text().split()), []
    for algorithm in ("softgm", "mappo"):
        folder = campaign.CAMPAIGN / "wall" / algorithm / "seed0" / "robustness"
        rates = [
            json.loads((folder / name / "summary.json").read_text())["metrics"]["success_rate"]["mean"]
            for name in campaign.CONDITIONS.values()
        ]
        told.append("{:.0f}, {:.0f} and {:.0f}".format(*(100.0 * (rates[0] - rate) + 1e-9 for rate in rates[1:])))
    assert "cost SoftGM {}, MAPPO {}**".format(*told).replace("-0", "0") in page


def test_the_cells_of_a_task_have_equal_budgets_whatever_the_algorithm(campaign):
    for run in campaign.runs().values():
        settings = campaign.asked(run.final.task)
        assert settings["frames"] <= run.final.frames < settings["frames"] + 20_000, run.final.folder
        assert len(run.final.episodes["success"]) == settings["episodes"] == 1000


def test_what_is_said_of_a_million_frames_of_basic_is_what_its_cells_hold(campaign):
    final, rising = {}, 0
    for algorithm in ("softgm", "mappo", "ippo"):
        folders = [campaign.CAMPAIGN / "basic" / algorithm / f"seed{seed}" for seed in range(3)]
        found = [json.loads((folder / "summary.json").read_text())["final_evaluation"] for folder in folders]
        final[algorithm] = np.array([one["success_rate"]["mean"] for one in found])
        for folder in folders:
            lines = [json.loads(line) for line in (folder / "evaluations.jsonl").read_text().splitlines()]
            rising += lines[-1]["success_rate"]["mean"] > lines[-3]["success_rate"]["mean"]
    assert rising == 8  # of nine
    others = np.stack([final["mappo"], final["ippo"]])
    assert final["softgm"].min() > others.max() > others.min() > 0.657
    assert 0.0 < others[0].mean() - others[1].mean() < np.ptp(others, axis=1).min()
    page = " ".join(campaign.PAGE.read_text().split())
    assert (
        "on average {:.0f} and {:.0f} points above them".format(*100 * (final["softgm"].mean() - others.mean(1)))
        in page
    )
    whole, without2, without1, maddpg = (
        campaign.runs()[f"basic/{label}/seed0"].summary["final_evaluation"]["success_rate"]["mean"]
        for label in ("softgm", "softgm_no_stage2", "softgm_no_stage1", "maddpg")
    )
    assert maddpg > max(final["softgm"].max(), others.max())
    assert f"MADDPG's one seed is above them all, {maddpg:.3f}" in page
    again = campaign.runs()["basic/softgm_no_stage2/seed1"].summary["final_evaluation"]["success_rate"]["mean"]
    told = (
        f"{whole:.3f} whole, at {without2:.3f} without stage 2, where nobody hears anybody ({again:.3f} with seed 1), "
        f"and at **{without1:.3f}"
    )
    assert f"Seed 0 ends at {told} without stage 1" in page
    seeds = (
        campaign.runs()[f"basic/softgm_no_stage1/seed{seed}"].summary["final_evaluation"]["success_rate"]["mean"]
        for seed in (1, 2)
    )
    assert "told of** ({:.3f} and {:.3f} with seeds 1 and 2)".format(*seeds) in page
    deep = json.loads((ROOT / "experiments/trials/basic/softgm_no_stage1_layers-4/summary.json").read_text())
    deep = deep["final_evaluation"]["success_rate"]
    assert "seed 0 ends at {mean:.3f} [{low:.3f}, {high:.3f}]**".format(**deep) in page
    assert deep["mean"] - without1 > 0.5 * (whole - without1)


def test_a_run_that_is_shorter_than_its_cell_is_no_part_of_the_campaign(campaign, monkeypatch, tmp_path):
    folder = tmp_path / "campaign" / "wall" / "softgm" / "seed0"
    shutil.copytree(campaign.CAMPAIGN / "wall" / "softgm" / "seed0", folder)
    config = folder / "config.yaml"
    config.write_text(config.read_text().replace("total_frames: 3000000", "total_frames: 2000000"))
    monkeypatch.setattr(campaign, "CAMPAIGN", tmp_path / "campaign")
    campaign.runs.cache_clear()
    with pytest.raises(SystemExit, match=r"^wall/softgm/seed0: it has .*2000000.* the cell .*3000000"):
        campaign.runs()
    campaign.runs.cache_clear()


@pytest.fixture(scope="module")
def sim_to_sim():
    return script(ROOT / "experiments" / "sim_to_sim.py")


def test_the_table_of_policies_in_pyelastica_is_made_from_the_committed_episodes(sim_to_sim):
    page = sim_to_sim.PAGE.read_text()
    assert sim_to_sim.page(page) == page


@pytest.mark.parametrize("task", ["basic", "structured", "wall"])
def test_simulators_that_are_compared_played_the_same_scenes_with_the_same_policy(sim_to_sim, task):
    ours, *theirs = (sim_to_sim.summary(task, place) for place in ("numba", "pyelastica", "pyelastica_as_shipped"))
    told = ("backend", "overrides", "pruning", "metrics")
    for summary, pruning in zip(theirs, (False, True), strict=True):
        assert (ours["backend"], summary["backend"], summary["pruning"]) == ("numba", "pyelastica", pruning)
        assert {key: ours[key] for key in ours if key not in told} == {
            key: summary[key] for key in summary if key not in told
        }


def test_every_kept_policy_has_a_card_made_from_its_committed_run():
    cards = script(ROOT / "experiments" / "cards.py")
    assert cards.PAGE.read_text() == cards.page()
    found = list(cards.cards())
    assert [card.file for card in found] == POLICIES
    for card in found:
        assert card.file.stem == f"{card.run.final.task}_{card.run.final.label}"
        beside = ROOT / "experiments" / card.folder / "policy.pt"
        if beside.exists():
            assert policy.fingerprint(policy.load(beside)) == policy.fingerprint(card.trained)
        if card.folder.parts[0] == "campaign":
            again, shown = compose(shlex.split(cards.command(card))[3:]), card.trained.run
            for key in ("seed", "threads", "matmul", "observation", "model", "algo", "rod"):
                assert getattr(again, key) == getattr(shown, key), (card.file, key)


def test_what_embeddings_know_of_an_opening_is_stated_of_the_committed_policies():
    probe = script(ROOT / "experiments" / "probe.py")
    text = probe.PAGE.read_text()
    assert probe.page(text) == text
    known = {}
    for name, path in probe.POLICIES.items():
        figures = json.loads((probe.FOLDER / f"{name}.json").read_text())
        assert figures["parameters"] == policy.fingerprint(policy.load(path))
        known[name] = {row["step"]: row for row in figures["rows"]}
    said = " ".join(text.split())
    for words, name, step, sources in (
        (r"embeddings know ([0-9.]+) on `wall` then, ([0-9.]+) with obstacles hidden", "wall", 12, "embedding hidden"),
        (r"is open \(([0-9.]+)\) and the body knows nothing \((-?[0-9.]+)\)", "wall_sense", 6, "embedding own"),
    ):
        (stated,) = re.findall(words, said)
        row = known[f"{name}_softgm"][step]
        assert stated == tuple(f"{row[source]:.2f}" for source in sources.split())


def test_a_readout_explains_what_is_linear_and_nothing_of_what_is_random():
    probe = script(ROOT / "experiments" / "probe.py")
    inputs = torch.randn(500, 40, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    assert probe.explained(inputs, inputs[:, :2] + 3.0) > 0.99
    assert probe.explained(inputs[:, 2:], inputs[:, :2]) < 0.05


def test_no_kept_policy_names_a_folder_of_the_machine_that_trained_it():
    committed = [*POLICIES, *(ROOT / "experiments").glob("*/*/*/seed*/policy.pt")]
    assert len(committed) > len(POLICIES)
    for path in committed:
        assert policy.load(path).run.run_dir.startswith("outputs/"), path


@pytest.mark.parametrize(
    ("evaluations", "frames", "name"),
    [
        ("trials/wall/envs-128_promote-0.5_entropy-0.003/policy-2400000", 2_400_000, "gamma 0.95"),
        ("campaign/wall/softgm/seed0/evaluations", 3_001_600, "gamma 0.98"),
        ("campaign/wall/mappo/seed0/evaluations", 3_008_000, "MAPPO on `wall`"),
        ("campaign/wall_touch/softgm/seed0/evaluations", 3_001_600, "`wall_touch`"),
        ("campaign/wall_sense/softgm/seed0/evaluations", 3_001_600, "`wall_sense`"),
    ],
)
def test_a_kept_policy_is_that_of_its_evaluations_and_the_page_says_what_they_hold(results, evaluations, frames, name):
    page = results.PAGE.read_text() + (ROOT / "docs" / "choosing.md").read_text()
    folder = ROOT / "experiments" / evaluations
    kept = folder.with_name("policy.pt") if folder.name == "evaluations" else folder.with_suffix(".pt")
    assert policy.load(kept).frames == frames
    rows = {"none": "what agents have sensed", "blind": "no obstacle", "swap_obstacles": "another scene's obstacles"}
    summaries = [json.loads((folder / intervention / "summary.json").read_text()) for intervention in rows]
    assert {summary["policy"] for summary in summaries} == {policy.fingerprint(policy.load(kept))}
    for (intervention, shown), summary in zip(rows.items(), summaries, strict=True):
        assert (summary["intervention"], summary["frames"]) == (intervention, frames)
        metrics = summary["metrics"]
        cells = [f"{metrics[key]['mean']:.3f}" for key in ("success_rate", "success_certified")]
        assert f"| {name}, {shown} | {' | '.join(cells)} | {metrics['motionless_failures']} |" in page


def test_the_published_policies_that_a_kept_trial_is_compared_with_played_the_same_scenes(results):
    page = results.PAGE.read_text()
    trial = results.episodes_in(results.TRIAL)["none"]["success"]
    rows = {
        "softgm": "the published SoftGM, what agents have sensed",
        "softgm_oracle": "the published oracle, and where the opening is",
    }
    for label, shown in rows.items():
        metrics = json.loads((results.FAILURES / "wall" / label / "summary.json").read_text())["metrics"]
        split = mcnemar(trial, results.episodes_in(results.FAILURES)[f"wall/{label}"]["success"])
        cells = [f"{metrics[key]['mean']:.3f}" for key in ("success_rate", "success_certified")]
        assert (
            f"| {shown} | {' | '.join(cells)} | {metrics['motionless_failures']} | {split.lost}, {split.won} |" in page
        )


def test_what_interventions_cost_mappo_on_the_wall_is_what_its_cell_holds(results):
    page = results.PAGE.read_text()
    played = results.episodes_in(ROOT / "experiments/campaign/wall/mappo/seed0/evaluations")
    rows = {
        "what agents have sensed": (results.episodes_in(results.TRIAL)["none"], "none"),
        "no obstacle": (played["none"], "blind"),
        "another scene's obstacles": (played["none"], "swap_obstacles"),
        "only what is sensed now": (played["none"], "sensed_only"),
    }
    for shown, (usual, intervention) in rows.items():
        split = mcnemar(usual["success"], played[intervention]["success"])
        row = rf"^\| MAPPO on `wall`, {shown} \| {played[intervention]['success'].mean():.3f} \|"
        assert re.search(rf"{row}.*\| {split.lost}, {split.won} \| [^|]* \|$", page, re.MULTILINE), shown


def test_what_the_walls_recipe_reached_is_its_runs_own_final_evaluation(results):
    folder = ROOT / "experiments/campaign/wall/softgm/seed0"
    final = json.loads((folder / "summary.json").read_text())["final_evaluation"]
    success = final["success_rate"]
    told = f"{success['mean']:.3f} [{success['low']:.3f}, {success['high']:.3f}] of {final['episodes']} scenes, "
    told += f"{final['success_by_step']['400']:.3f} within 400 steps; {final['motionless_failures']} arms stood still"
    assert told in " ".join(results.PAGE.read_text().split())


def folders_elsewhere(results):
    found = sorted(path.parent for path in results.SECTIONS.glob("*/*/*/summary.json"))
    assert len(found) >= 20
    return found


def test_policies_were_tested_elsewhere_in_the_settings_that_their_folders_name_and_are_the_kept_ones(results):
    earlier = {"wall_softgm": ROOT / "experiments/trained/wall/softgm/seed0/policy.pt"}
    files = {path.stem: path for path in POLICIES} | earlier
    names = {stem: policy.fingerprint(policy.load(path)) for stem, path in files.items()}
    for folder in folders_elsewhere(results):
        task, algo, name = folder.relative_to(results.SECTIONS).parts
        summary = json.loads((folder / "summary.json").read_text())
        assert (summary["policy"], summary["task"]) == (names[f"{task}_{algo}"], task), folder
        assert (summary["metrics"]["episodes"], summary["horizon"]) == (200, 200 if task == "basic" else 400)
        coarse = summary.get("torque_sections")
        settings = [f"torque_sections={coarse}"] if coarse else summary["overrides"] or [results.AS_TRAINED]
        changes = [re.sub(r"^(\w+\.)*(\w+)=", r"\2-", setting) for setting in settings]
        assert "_".join(change for change in changes if not change.startswith("resting_tip")) == name, folder


def test_what_is_discovered_with_six_and_twelve_sections_is_stated_as_the_committed_episodes_have_it(results):
    page = " ".join(results.PAGE.read_text().split())
    found = results.episodes_in(results.SECTIONS)
    for words, algo in (
        (r"MAPPO discovers (\d+) bins an episode with six sections and (\d+) with twelve", "mappo"),
        (r"SoftGM discovers (\d+) and (\d+), but", "softgm"),
    ):
        stated = re.search(words, page).groups()
        bins = [found[f"wall/{algo}/n_agents-{n}"]["discovered_bins"].mean() for n in (6, 12)]
        assert [f"{mean:.0f}" for mean in bins] == list(stated)
    assert "Divergences: none" in page
    assert not any(episodes["diverged"].any() for episodes in found.values())


def test_a_coarse_torque_field_goes_through_the_policys_own_at_fewer_control_points(results):
    coarse = script(ROOT / "experiments" / "coarse_torque.py")
    trained = policy.load(ROOT / "experiments" / "policies" / "basic_softgm.pt")
    task, rod = trained.config.task, trained.config.rod
    own = Actuation(rod, task.n_agents, task.actuation.max_torque).matrix
    torch.testing.assert_close(coarse.coarse_matrix(trained, task.n_agents), own, rtol=0.0, atol=1e-12)
    fine = replace(rod, n_elements=2000, dt=1e-5)
    trained.config = replace(trained.config, rod=fine)
    action = torch.rand(6, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    whole = Actuation(fine, 6, 25.0).matrix
    found, field = (action @ matrix for matrix in (coarse.coarse_matrix(trained, 4), whole))
    places = torch.tensor([400, 800, 1200, 1600])
    torch.testing.assert_close(found[places], field[places], rtol=2e-2, atol=1e-5)
    page = " ".join(results.PAGE.read_text().split())
    stated = re.search(r"(\d+) % with four [^,]*, (\d+) % with five, (\d+) % with seven and (\d+) % with twelve", page)
    for share, sections in zip(stated.groups(), (4, 5, 7, 12), strict=True):
        assert f"{100 * (coarse.coarse_matrix(trained, sections) - whole).norm() / whole.norm():.0f}" == share


def test_committed_evaluations_count_the_scenes_that_are_certified_today():
    recertify = script(ROOT / "experiments" / "recertify.py")
    folders = list(recertify.evaluations())
    assert len(folders) >= 10
    for folder in folders:
        rows, summary = recertify.marked(folder)
        assert json.loads((folder / "summary.json").read_text()) == json.loads(json.dumps(summary)), folder
        with (folder / "episodes.csv").open(newline="") as file:
            assert list(csv.DictReader(file)) == rows, folder


INTERVENTIONS = {
    "what agents have sensed": "none",
    "no obstacle": "blind",
    "another scene's obstacles": "swap_obstacles",
    "only what is sensed now": "sensed_only",
    "bins without lengths": "hide_lengths",
}


@pytest.mark.parametrize(("algo", "column"), [("softgm", 0), ("mappo", 3)])
def test_what_interventions_cost_is_stated_as_the_committed_episodes_have_it(algo, column, results):
    folder = ROOT / "experiments" / "interventions" / "wall" / algo
    page = results.PAGE.read_text()

    def success(intervention):
        with (folder / intervention / "episodes.csv").open() as episodes:
            return np.array([row["success"] == "True" for row in csv.DictReader(episodes)])

    usual = success("none")
    for words, intervention in INTERVENTIONS.items():
        (row,) = [line for line in page.splitlines() if line.startswith(f"| {words} |")]
        rate, changed = (cell.strip() for cell in row.split("|")[2 + column : 4 + column])
        shown = success(intervention)
        assert float(rate) == pytest.approx(shown.mean(), abs=5e-4)
        if intervention != "none":
            lost, won = (usual > shown).sum(), (shown > usual).sum()
            assert changed == f"{lost}, {won}"


@pytest.mark.parametrize("algo", ["softgm", "mappo"])
def test_a_kept_policy_still_reaches_targets(algo):
    trained = policy.load(ROOT / "experiments" / "policies" / f"basic_{algo}.pt")
    env = make_env(trained.config.task, trained.config.rod, num_envs=64, seed=3, horizon=100)
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        episodes = env.rollout(100, trained.policy, break_when_any_done=False)
    assert episodes["next"][entries.SUCCESS].any(dim=1).double().mean() > 0.85


def test_the_curves_of_what_was_tried_are_those_of_the_committed_runs():
    trials = script(ROOT / "experiments" / "trials.py")
    text = trials.PAGE.read_text()
    assert trials.page(text) == text
    whole = trials.curve(trials.EXPERIMENTS / "campaign/wall/softgm/seed0")
    assert list(whole) == list(range(1, 13))


def test_mlps_on_walls_have_the_settings_of_the_run_whose_recipe_they_are_said_to_have(results):
    now = compose(["task=wall", "algo=mappo"])
    (run,) = [run for run in results.runs("wall") if run.final.label == "mappo"]
    then = run.config
    for key in ("num_envs", "steps_per_batch", "train_horizon"):
        assert getattr(now.experiment, key) == then["experiment"][key]
    learner = OmegaConf.to_container(OmegaConf.structured(now.algo))
    for key, value in then["algo"].items():
        held = learner[key]
        assert ({name: held[name] for name in value} if isinstance(value, dict) else held) == value, key
    assert now.task.curriculum.promote == then["task"]["curriculum"]["promote"]


def test_what_is_said_of_a_mixture_of_sections_is_what_was_played():
    page = (ROOT / "docs/training.md").read_text()
    told = {"4, 6 and 8": "sections-4-6-8", "6 alone": "sections-6"}
    for name, folder in told.items():
        (row,) = re.findall(rf"^\| {name} \| (.*) \|$", page, re.MULTILINE)
        played = ROOT / "experiments/trials/basic" / folder / "evaluations/4-6-8/summary.json"
        metrics = json.loads(played.read_text())["metrics"]
        rates = [metrics[f"success_rate_n{number}"] for number in (4, 6, 8)]
        assert row.split(" | ") == [f"{rate['mean']:.2f} [{rate['low']:.2f}, {rate['high']:.2f}]" for rate in rates]


@pytest.fixture(scope="module")
def bodies():
    return script(ROOT / "experiments" / "bodies.py")


def test_the_tables_of_drawn_bodies_are_made_from_the_committed_episodes(bodies):
    page = bodies.PAGE.read_text()
    assert bodies.page(page) == page


def test_bodies_that_are_compared_played_the_same_scenes_with_the_same_policy(bodies):
    told = ("backend", "overrides", "randomise", "metrics", "horizon")
    for subject in bodies.POLICIES:
        nominal = bodies.summary(subject, "none")
        assert "randomise" not in nominal
        for arguments in bodies.wanted():
            if arguments[0] == subject:
                summary = bodies.summary(*arguments)
                assert summary.get("randomise", {"name": "none"})["name"] == arguments[1]
                assert summary["backend"] == arguments[2]
                assert {key: nominal[key] for key in nominal if key not in told} == {
                    key: summary[key] for key in summary if key not in told
                }


def test_bodies_of_committed_evaluations_lie_in_their_ranges_and_belong_to_the_episodes_number(bodies):
    drawn = [bodies.columns(subject, "wide") for subject in bodies.POLICIES]
    for name in bodies.FACTORS:
        low, high = bodies.summary("basic/softgm", "wide")["randomise"][name]
        values = [one[f"body_{name}"] for one in drawn]
        assert low - 1e-6 <= values[0].min() <= values[0].max() <= high + 1e-6
        assert all(np.array_equal(values[0], other) for other in values)
        moderate = bodies.columns("basic/softgm", "moderate")[f"body_{name}"]
        assert name == "friction_coefficient" or np.array_equal(moderate.argsort(), values[0].argsort())
