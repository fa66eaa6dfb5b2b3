"""What the results say of walls that have to be felt or sensed is what the committed runs hold."""

import csv
import json
import re
from pathlib import Path

import numpy as np
import pytest
from omegaconf import OmegaConf

from committed import ROOT, script
from softgm_bench.analysis.statistics import mcnemar
from softgm_bench.episodes import certified, policy

CHOOSING = ROOT / "docs" / "choosing.md"


@pytest.fixture(scope="module")
def results():
    return script(ROOT / "experiments" / "results.py")


def reached(folder):
    """Success of a run after a quarter of a million frames and so on, as curves on the page have it."""
    found = script(ROOT / "experiments" / "trials.py").curve(folder)
    return [f"{found[number]:.2f}" if number in found else "" for number in (1, 2, 3, 4, 5, 6, 8, 10, 12)]


def row_of(page, name):
    """Cells of the table's row that begins with a name."""
    return [cell.strip() for cell in re.search(rf"^\| {re.escape(name)} \|(.*)\|$", page, re.MULTILINE)[1].split("|")]


def rows(path):
    """A committed table."""
    with path.open() as file:
        return list(csv.DictReader(file))


def touching(folder):
    """Control steps in contact of each episode of an evaluation, infinitely many where it failed."""
    episodes = rows(folder / "episodes.csv")
    return np.array([int(row["contact_steps"]) if row["success"] == "True" else np.inf for row in episodes])


def millions(folder):
    """Frames of a training, as the page tells them."""
    return f"{int(rows(folder / 'metrics.csv')[-1]['frames']) / 1e6:.2f}"


def by_side(success):
    """Success in the certified scenes of `wall_sense` whose open opening is on the arm's left, and in the others."""
    left = certified.of_task("wall_sense").privileged[:, 1] > 0.0
    return [f"{success[side].mean():.3f}" for side in (left, ~left)]


BUMPING = {  # rows of the page: the run whose curve it shows, and the evaluation whose contact it counts
    "SoftGM": ("campaign/wall_touch/softgm/seed0", "evaluations/none"),
    "SoftGM without stage 1": ("campaign/wall_touch/softgm_no_stage1/seed0", "evaluations/none"),
}


@pytest.mark.parametrize("name", BUMPING)
def test_what_is_said_of_bumping_is_what_the_committed_curves_and_episodes_hold(name, results):
    run, evaluation = BUMPING[name]
    page = results.PAGE.read_text().partition("### A wall that has to be felt")[2].partition("\n### ")[0]
    curve, contact = (
        [cell.strip() for cell in row.split("|")[2:-1]] for row in re.findall(rf"^\| {name}(?: \||,).*", page, re.M)
    )
    assert curve == reached(ROOT / "experiments" / run)
    touched = touching(ROOT / "experiments" / run / evaluation)
    assert contact == [f"{(touched <= steps).mean():.2f}" for steps in (0, 1, 2, 3, 5, 10)]


SENSING = {  # rows of the page: folders
    "SoftGM, seed 0": "campaign/wall_sense/softgm/seed0",
    "SoftGM, seed 1": "campaign/wall_sense/softgm/seed1",
    "SoftGM without stage 1, seed 0": "campaign/wall_sense/softgm_no_stage1/seed0",
    "SoftGM, seed 0, `promote=0.75`": "trials/wall_sense/seed0_promote-0.75",
    "SoftGM, seed 0, `promote=0.75`, `demote=0.5`": "trials/wall_sense/seed0_promote-0.75_demote-0.5",
    "SoftGM, seed 1, `promote=0.75`": "trials/wall_sense/seed1_promote-0.75",
    "SoftGM, seed 0, `easier_share=0.5`": "trials/wall_sense/seed0_share-0.5",
    "SoftGM, seed 1, `easier_share=0.5`": "trials/wall_sense/seed1_share-0.5",
    "SoftGM, seed 0, `mirror=average`": "trials/wall_sense/seed0_average",
    "SoftGM, seed 1, `mirror=average`": "trials/wall_sense/seed1_average",
    "SoftGM without stage 1, seed 0, `mirror=average`": "trials/wall_sense/blind0_average",
    "SoftGM, seed 0, `mirror=canonical`": "trials/wall_sense/seed0_canonical",
    "SoftGM, seed 0, one step of contact": "trials/wall_sense/contact1_seed0",
    "SoftGM, seed 0, no contact, `mirror=average`": "trials/wall_sense/contact0_seed0_average",
    "SoftGM, seed 0, no contact, `easy_contact_steps=5`, `mirror=average`": "trials/wall_sense/eased0_seed0_average",
    "SoftGM without stage 1, seed 0, no contact, `easy_contact_steps=5`, `mirror=average`": (
        "trials/wall_sense/eased0_blind0_average"
    ),
    "SoftGM, seed 0, no push, `easy_contact_steps=10`, `mirror=average`": "trials/wall_sense/within0_seed0_average",
    "SoftGM, seed 1, no push, `easy_contact_steps=10`, `mirror=average`": "trials/wall_sense/within0_seed1_average",
    "SoftGM, seed 0, no push, `easy_contact_steps=20`, `easy_target_offset=1`, `promote=0.75`, `mirror=average`": (
        "trials/wall_sense/within0_offset_seed0_average"
    ),
}


@pytest.mark.parametrize("name", SENSING)
def test_the_curves_of_the_choice_between_two_openings_are_those_of_the_committed_runs(name, results):
    page = CHOOSING.read_text()
    assert row_of(page, name) == reached(ROOT / "experiments" / SENSING[name])


def test_what_is_said_of_the_choice_between_two_openings_is_what_the_committed_runs_hold(results):
    page = " ".join(CHOOSING.read_text().split())
    folders = [ROOT / "experiments" / folder for folder in list(SENSING.values())[:3]]
    finals = [json.loads((folder / "summary.json").read_text())["final_evaluation"] for folder in folders]
    blind = finals[2]
    told = ["{mean:.3f} [{low:.3f}, {high:.3f}]".format(**one["success_rate"]) for one in finals]
    assert f"**SoftGM {told[0]} with seed 0 and {told[1]} with seed 1, without stage 1 {told[2]}**" in page
    failures = round(blind["episodes"] * (1.0 - blind["success_rate"]["mean"]))
    assert f"({blind['motionless_failures']} of its {failures} failures; none is of contact" in page
    assert blind["contact_failure"] == 0
    scenes = [results.episodes_in(folder / "evaluations")["none"]["success"] for folder in folders]
    split = mcnemar(scenes[0], scenes[2])
    assert f"the same 500 scenes give {scenes[2].mean():.3f} ({split.lost} lost and {split.won} won against" in page
    sides = [share for success in scenes for share in by_side(success)]
    assert (
        "in {2} of those whose open opening is on the arm's left (y > 0) and in {3} of the others".format(*sides)
        in page
    )
    assert "the blind policy in {4} and {5}; seed 0 in {0} and {1}".format(*sides) in page
    hidden = results.episodes_in(folders[1] / "evaluations")["blind"]["success"].mean()
    assert f"shown no obstacle it succeeds in {hidden:.3f} of them" in page


def test_what_is_said_of_the_trial_that_chooses_is_what_it_holds(results):
    page = " ".join(CHOOSING.read_text().split())
    folder = ROOT / "experiments" / SENSING["SoftGM, seed 1, `promote=0.75`"]
    final = json.loads((folder / "summary.json").read_text())["final_evaluation"]
    assert "{mean:.3f} [{low:.3f}, {high:.3f}] of 1000 scenes at the end".format(**final["success_rate"]) in page
    played = {shown: episodes["success"] for shown, episodes in results.episodes_in(folder / "evaluations").items()}
    shown = [f"{played[shown].mean():.3f}" for shown in ("blind", "swap_obstacles")]
    told = (
        "in the 500 scenes {} with the open opening on the left and {} with it on the right, {} when shown no obstacle "
    )
    assert (told + "and {} when shown another scene's").format(*by_side(played["none"]), *shown) in page


def test_what_is_said_of_a_curriculum_that_goes_back_is_what_its_trial_holds(results):
    folder = ROOT / "experiments" / SENSING["SoftGM, seed 0, `promote=0.75`, `demote=0.5`"]
    curve = script(ROOT / "experiments" / "trials.py").curve(folder)
    told = ", ".join(f"{curve[number]:.2f}" for number in (5, 6, 7))
    page = " ".join(CHOOSING.read_text().split())
    assert f"{told} of 256 scenes after 1.25, 1.5, 1.75 million frames" in page


def test_easier_scenes_were_stopped_when_the_page_says(results):
    names = (f"SoftGM, seed {seed}, `easier_share=0.5`" for seed in (0, 1))
    frames = [millions(ROOT / "experiments" / SENSING[name]) for name in names]
    told = "stopped after {} and {} million frames): a target".format(*frames)
    assert told in " ".join(CHOOSING.read_text().split())


def test_what_is_said_of_the_mirror_is_what_its_trials_hold(results):
    curve = script(ROOT / "experiments" / "trials.py").curve
    trained = {name: ROOT / "experiments" / folder for name, folder in SENSING.items()}
    seed0, seed1 = (trained[f"SoftGM, seed {seed}, `mirror=average`"] for seed in (0, 1))
    blind = trained["SoftGM without stage 1, seed 0, `mirror=average`"]
    canonical = trained["SoftGM, seed 0, `mirror=canonical`"]
    without = (trained["SoftGM, seed 0"], trained["SoftGM, seed 1"])
    half = [f"{curve(folder)[2]:.2f}" for folder in (seed0, seed1, *without)]
    page = " ".join(CHOOSING.read_text().split())
    assert "succeed in {} and {} of the scenes, without it in {} and {}.".format(*half) in page
    after = [f"{curve(folder)[number]:.2f}" for number in (6, 4) for folder in (seed0, seed1)]
    told = "seed 0 succeeds in {} of 256 scenes and seed 1, which never chooses without the mirror, in {} after 1.5 "
    assert (told + "million frames; at a million it was {} and {}.").format(*after) in page
    told = f"stopped by the clock after {millions(seed0)} million frames ({curve(seed0)[8]:.2f} after 2 million)"
    assert told in page
    final = json.loads((seed1 / "summary.json").read_text())["final_evaluation"]
    assert "ended at {mean:.3f} [{low:.3f}, {high:.3f}] of 1000 scenes".format(**final["success_rate"]) in page
    played = {shown: found["success"].mean() for shown, found in results.episodes_in(seed1 / "evaluations").items()}
    told = "it has {none:.3f}, when shown no obstacle {blind:.3f}, when shown another scene's {swap_obstacles:.3f}:"
    assert told.format(**played) in page
    told = "{:.2f} of 256 scenes after 1.25 million frames and {:.2f} after 1.5 million, where without the mirror it"
    assert told.format(curve(blind)[5], curve(blind)[6]) in page
    alone = results.episodes_in(blind / "evaluations")["none"]["success"].mean()
    assert f"As it was after {millions(blind)} million frames it succeeds in {alone:.3f} of the 500 scenes. Nor" in page
    told = "chooses too ({mean:.3f}), but so does one that senses nothing ({alone:.3f} after half"
    told = told.format(**final["success_rate"], alone=alone)
    assert told in " ".join((ROOT / "README.md").read_text().split())
    assert f"a million frames ({curve(canonical)[4]:.2f} of 256 scenes)" in page
    assert f"it was stopped at {curve(canonical)[8]:.2f} after {millions(canonical)} million." in page


FELT = {  # rows of the page: the evaluation whose contact each counts
    "SoftGM, seed 0, 3 M frames": "campaign/wall_sense/softgm/seed0",
    "SoftGM, seed 1, `mirror=average`, 3 M frames": "trials/wall_sense/seed1_average",
    "SoftGM without stage 1, seed 0, `mirror=average`, 1.53 M frames": "trials/wall_sense/blind0_average",
}


def test_what_is_said_of_a_wall_that_may_not_be_touched_is_what_its_trials_hold(results):
    folder = ROOT / "experiments" / SENSING["SoftGM, seed 0, one step of contact"]
    touched = touching(folder / "evaluations" / "none")
    hidden = results.episodes_in(folder / "evaluations")["blind"]["success"].mean()
    rates = f"{np.isfinite(touched).mean():.3f}", f"{(touched == 0).mean():.3f}"
    left, right = by_side(np.isfinite(touched))
    page = " ".join(CHOOSING.read_text().split())
    told = "after {} million frames, in {} of the 500 scenes, in {} without any contact;"
    assert told.format(millions(folder), *rates) in page
    assert f"on one side again, {left} with the open opening on the left and {right} with it on the right," in page
    assert f"Shown no obstacle it succeeds in {hidden:.3f}: what" in page
    allowed = max((touching(ROOT / "experiments" / at / "evaluations" / "none") == 0).mean() for at in FELT.values())
    assert f"trained with five steps none has more than {allowed:.2f}." in page
    still = ROOT / "experiments" / SENSING["SoftGM, seed 0, no contact, `mirror=average`"]
    lengths = [float(row["episode_length"]) for row in rows(still / "metrics.csv")]
    told = f"After {millions(still)} million frames its episodes last {np.mean(lengths[-10:]):.0f} of 60 steps, and"
    assert told in page
    eased = ROOT / "experiments" / SENSING["SoftGM, seed 0, no contact, `easy_contact_steps=5`, `mirror=average`"]
    blind = eased.with_name("eased0_blind0_average")
    final = json.loads((eased / "summary.json").read_text())["final_evaluation"]["success_rate"]
    assert (
        "not to touch by this count: {mean:.3f} [{low:.3f}, {high:.3f}] of 1000 scenes after three".format(**final)
        in page
    )
    curve = script(ROOT / "experiments" / "trials.py").curve(eased)
    assert (
        f"({curve[6]:.2f} of 256 scenes), and from there on it learnt to go back and round ({curve[7]:.2f} after"
        in page
    )
    shown = {name: found["success"] for name, found in results.episodes_in(eased / "evaluations").items()}
    told = "500 scenes it has {none:.3f}, shown no obstacle {blind:.3f}, shown another scene's {swap_obstacles:.3f}."
    assert told.format(**{name: success.mean() for name, success in shown.items()}) in page
    alone = results.episodes_in(blind / "evaluations")["none"]["success"]
    split = mcnemar(shown["none"], alone)
    told = (
        f"after {millions(blind)} million frames, has {alone.mean():.3f} of them ({split.lost} lost and {split.won} won"
    )
    assert told in page
    failures = json.loads((blind / "evaluations" / "none" / "summary.json").read_text())["metrics"]
    crashed = failures["contact_failure"] / (1.0 - alone.mean()) / len(alone)
    assert 0.3 < crashed < 0.35  # two of three are of something else


def test_what_is_said_of_a_wall_that_may_not_push_is_what_its_trials_hold(results):
    names = (f"SoftGM, seed {seed}, no push, `easy_contact_steps=10`, `mirror=average`" for seed in (0, 1))
    folders = [ROOT / "experiments" / SENSING[name] for name in names]
    page = " ".join(CHOOSING.read_text().split())
    assert "stopped after {} and {} million frames: both".format(*map(millions, folders)) in page
    other = ROOT / "experiments/trials/wall_sense/within0_offset_seed0_average"
    last = [float(row["success_rate"]) for row in rows(other / "metrics.csv")[-50:] if int(row["episodes"])]
    assert f"After {millions(other)} million frames it succeeds in half of the easiest scenes" in page
    assert 0.45 < np.mean(last) < 0.55
    assert {float(row["difficulty"]) for row in rows(other / "metrics.csv")} == {0.0}
    played = results.episodes_in(folders[0] / "evaluations")
    success, hidden = (played[shown]["success"] for shown in ("none", "blind"))
    metrics = json.loads((folders[0] / "evaluations" / "none" / "summary.json").read_text())["metrics"]
    assert metrics["contact_failure"] == (success == 0.0).sum()
    told = "seed 0 has {:.3f}, all of its {} failures are of contact, and shown no obstacle it has {:.3f}:"
    assert told.format(success.mean(), metrics["contact_failure"], hidden.mean()) in page


LATE = {  # rows of the page: trials in which contact becomes scarce after the scenes have become the task's own
    "SoftGM, seed 0": "within0_last_seed0_average",
    "SoftGM, seed 1": "within0_last_seed1_average",
    "SoftGM, seed 0, gone on with": "within0_last_seed0_average_resumed",
}


@pytest.mark.parametrize("name", LATE)
def test_how_far_contact_was_given_up_is_what_the_trials_hold(name):
    folder = ROOT / "experiments/trials/wall_sense" / LATE[name]
    metrics, config = rows(folder / "metrics.csv"), OmegaConf.load(folder / "config.yaml").task
    curriculum = config.curriculum
    assert (config.max_contact_steps, curriculum.easy_contact_steps) == (0, 50)
    assert (curriculum.stages, curriculum.contact_stages) == (30, 20)
    difficulty = np.array([float(row["difficulty"]) for row in metrics])
    frames = np.array([int(row["frames"]) for row in metrics])
    reached = [frames[difficulty > at - 1e-3] for at in (1 / 3, 2 / 3)]
    told = [f"{found[0] / 1e6:.2f} M" if len(found) else "" for found in reached]
    last = [(int(row["episodes"]), float(row["success_rate"])) for row in metrics[-50:] if int(row["episodes"])]
    success = np.average([rate for _, rate in last], weights=[episodes for episodes, _ in last])
    left = 50.0 * (1.0 - difficulty[-1]) * 1.5
    told += [f"{millions(folder)} M", f"{left:.1f}", f"{success:.2f}"]
    page = CHOOSING.read_text()
    assert row_of(page.partition("## First to choose")[2], name) == told
    passed = frames[difficulty > 1 / 3 + 1e-3][0] / 1e6
    assert f"{passed:.2f} million" in page or f"after {passed:.2f}." in page


def test_what_an_arm_does_that_is_let_push_is_what_its_episodes_hold():
    scenes = certified.of_task("wall_sense")
    closed = (scenes.privileged[:, 1] > 0.0) != (scenes.target[:, 1] > 0.0)  # on the side of the target
    page = " ".join(CHOOSING.read_text().split())
    shares = []
    for trial in (LATE["SoftGM, seed 0"], LATE["SoftGM, seed 0, gone on with"]):
        episodes = rows(ROOT / "experiments/trials/wall_sense" / trial / "evaluations/let_push/episodes.csv")
        success = np.array([row["success"] == "True" for row in episodes])
        length = np.array([int(row["length"]) for row in episodes])
        shares.append((success.mean(), success[closed].mean(), np.median(length[closed & success])))
    assert f"succeeds in {shares[0][0]:.3f} of the 500 scenes" in page
    assert f"half of its successes take more than {shares[0][2]:.0f} steps" in page
    assert f"Let push, it still succeeds in {shares[1][1]:.3f} of those scenes" in page


@pytest.mark.parametrize("name", FELT)
def test_how_often_a_wall_is_touched_on_the_way_is_what_the_committed_episodes_hold(name, results):
    touched = touching(ROOT / "experiments" / FELT[name] / "evaluations" / "none")
    assert row_of(CHOOSING.read_text(), name) == [f"{(touched <= steps).mean():.2f}" for steps in range(6)]


def figures_of(made_by):
    """Committed figures of a script that fills a table, by name, after the checks that all such scripts share."""
    text = made_by.PAGE.read_text()
    assert made_by.page(text) == text
    held = {figures["name"]: figures for figures in map(json.loads, map(Path.read_text, made_by.FOLDER.glob("*.json")))}
    for name, path in made_by.POLICIES.items():
        assert held[name]["parameters"] == policy.fingerprint(policy.load(path))
        assert len(held[name]["shares"]) == len(made_by.COLUMNS)
    return held


def test_the_table_of_sides_is_that_of_the_committed_figures_of_the_kept_policies():
    sides = script(ROOT / "experiments" / "sides.py")
    held = figures_of(sides)
    assert held.keys() > sides.POLICIES.keys()
    for figures in held.values():
        assert (figures["seed"], figures["episodes"]) == (sides.SEED, sides.EPISODES)
        assert len(figures["shares"]) == len(sides.COLUMNS)


def test_the_table_of_touches_is_that_of_the_committed_figures_of_the_kept_policies(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "experiments")
    touches = script(ROOT / "experiments" / "touches.py")
    held = figures_of(touches)
    assert held.keys() == touches.POLICIES.keys()
    touch, blind_touch, eased, blind = (held[name]["shares"] for name in touches.POLICIES)
    page = " ".join(CHOOSING.read_text().split())
    assert f"lean on the wall for {eased[2]:.0f} steps of an episode, the blind one for {blind[2]:.0f}.**" in page
    missed = (f"{shares[2] / shares[1]:.1f}" for shares in (touch, blind_touch))
    assert "arms are pushed in {} and {} times as many steps as are counted.".format(*missed) in page


def test_what_is_said_of_the_curriculum_is_what_the_committed_trainings_hold(results):
    page = " ".join(CHOOSING.read_text().split())
    told = []
    for name in ("SoftGM, seed 1", "SoftGM, seed 0", "SoftGM, seed 1, `promote=0.75`"):
        metrics = rows(ROOT / "experiments" / SENSING[name] / "metrics.csv")
        there = [row for row in metrics if 480_000 < int(row["frames"]) <= 550_000]
        episodes = np.array([int(row["episodes"]) for row in there])
        success = np.array([float(row["success_rate"]) for row in there])[episodes > 0]
        difficulty = np.mean([float(row["difficulty"]) for row in there])
        told += [f"{difficulty:.2f}", f"{np.average(success, weights=episodes[episodes > 0]):.2f}"]
    said = "at a difficulty of {} with {} of its episodes successes, .*; seed 0 at {} with {}\\..* at {}, with {}\\."
    assert re.search(said.format(*told), page), told


KNOWING = {  # rows of the page: the trial whose curve each shows
    "whole, sensing from 0.15 m": "wall_touch/contact-2_fail-40",
    "without stage 1": "wall_touch/contact-2_fail-40_no-stage1",
    "whole, sensing from 0.25 m": "wall_touch/contact-2_fail-40_sense-0.25",
    "without stage 1, rewarded for what is discovered from 0.25 m": "wall_touch/contact-2_fail-40_sense-0.25_no-stage1",
    "without stage 1, told where the opening is": "wall_touch/contact-2_fail-40_sense-0.25_oracle",
    "without stage 1, told which": "wall_decoy/closed_contact-5_sense-0.25_oracle",
    "without stage 1, not told": "wall_decoy/closed_contact-5_sense-0.25_blind",
}


@pytest.mark.parametrize("name", KNOWING)
def test_what_is_said_of_knowing_is_what_the_trials_hold(name, results):
    folder = ROOT / "experiments/trials" / KNOWING[name]
    page = results.PAGE.read_text().partition("### To know is not yet to pass")[2].partition("\n##")[0]
    lines = [json.loads(line) for line in (folder / "evaluations.jsonl").read_text().splitlines()]
    assert [cell for cell in row_of(page, name) if cell] == [f"{line['success_rate']['mean']:.2f}" for line in lines]
    if (folder / "evaluations").exists():
        scenes = [results.episodes_in(folder / "evaluations")[shown]["success"] for shown in ("none", "swap_opening")]
        split = mcnemar(*scenes)
        own, others = (f"{scene.mean():.3f}" for scene in scenes)
        told = f"{others} instead of {own} of 256 scenes ({split.lost} lost, {split.won} won"
        assert told in " ".join(page.split())


def test_the_table_of_pushes_is_that_of_the_committed_figures_of_the_kept_policies(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "experiments")
    pushes = script(ROOT / "experiments" / "pushes.py")
    assert figures_of(pushes).keys() == pushes.POLICIES.keys()


def test_what_is_said_of_a_price_of_contact_is_what_its_trials_hold(results):
    page = " ".join(CHOOSING.read_text().partition("## A price")[2].split())
    names = ("limit_seed0", "limit_seed1", "dear_seed0", "price_seed0")
    limit, other, dear, price = (ROOT / "experiments/trials/wall_sense" / name for name in names)
    metrics = rows(limit / "metrics.csv")
    frames = np.array([int(row["frames"]) for row in metrics])
    left = np.array([60.0 * (1.0 - float(row["difficulty"])) for row in metrics])  # one step a stage
    chosen = frames[left < 50.0 - 0.1][0] / 1e6
    at = left[frames == 1_401_600].item()
    assert f"seed 0 chooses after {chosen:.2f} million frames, has {at:.0f} steps in contact left after 1.40" in page
    assert f"{left[-1]:.0f} when it was stopped after {millions(limit)} million." in page
    assert f"was stopped after {millions(other)} million before" in page
    assert min(60.0 * (1.0 - float(row["difficulty"])) for row in rows(other / "metrics.csv")) > 50.0 - 0.1
    assert f"after {millions(dear)} million frames no episode of its last 20 iterations" in page
    assert not any(float(row["success_rate"]) for row in rows(dear / "metrics.csv")[-20:] if int(row["episodes"]))
    for trial in (limit, other):
        early = {row["frames"]: float(row["success_rate"]) for row in rows(trial / "metrics.csv")}
        assert early["160000"] > 0.87
    begun = OmegaConf.load(price / "config.yaml")
    assert (begun.task.reward.lambda_c, begun.task.max_contact_steps) == (-4.0, 50)
    assert not begun.task.curriculum.enabled
    summary = json.loads((price / "summary.json").read_text())
    kept = policy.load(limit / "policy-1401600.pt")
    assert summary["start"] == {
        "policy": begun.start.policy,
        "fingerprint": policy.fingerprint(kept),
        "frames": kept.frames,
    }
    assert (ROOT / begun.start.policy) == limit / "policy-1401600.pt"
    final = summary["final_evaluation"]["success_rate"]
    assert "at the end it succeeds in {mean:.3f} [{low:.3f}, {high:.3f}] of 1000".format(**final) in page.lower()
    shown = results.episodes_in(price / "evaluations")
    rates = "{none:.3f}, {blind:.3f} and {swap_obstacles:.3f} of the 500 scenes when shown"
    assert rates.format(**{name: episodes["success"].mean() for name, episodes in shown.items()}) in page
    assert f"If no push is allowed it has {shown['no_push']['success'].mean():.3f} of them" in page
    known = {file.stem: json.loads(file.read_text())["shares"] for file in (ROOT / "experiments/pushes").glob("*.json")}
    before, later, priced = (known[name] for name in sorted(known))
    assert (before[2] - later[2], before[2] - priced[2]) == (1.0, 10.0)
    assert priced[1] == 0.0 == priced[4]
