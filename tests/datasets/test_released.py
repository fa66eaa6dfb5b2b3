"""The data sets of this repository: whole, loaded by TorchRL alone, and their actions lead where they say they led."""

import importlib.util
import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.data import SamplerWithoutReplacement, TensorDictReplayBuffer, TensorStorage
from torchrl.envs.utils import step_mdp

from softgm_bench.datasets import layout, sheet
from softgm_bench.datasets.reading import load
from softgm_bench.envs import entries

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "experiments/datasets"
NAMES = ("basic", "wall")


@pytest.mark.parametrize("name", NAMES)
def test_a_released_data_set_is_what_its_checksums_and_its_datasheet_say(name):
    data = load(FOLDER / name)
    data.verify()
    told = (FOLDER / name / "datasheet.md").read_text()
    assert sheet.table(data.settings, data.episodes) in told
    assert f"{data.transitions} transitions of {len(data.episodes['length'])} whole episodes" in told
    assert sum(path.stat().st_size for path in (FOLDER / name).iterdir()) < 1_700_000


@pytest.mark.parametrize("name", NAMES)
def test_torchrl_alone_goes_once_through_a_released_chunk(name):
    frames = TensorDict.load_memmap(FOLDER / name / "chunk-00001.tdz")["frames"]
    buffer = TensorDictReplayBuffer(
        storage=TensorStorage(frames), sampler=SamplerWithoutReplacement(), batch_size=64, prefetch=0
    )
    buffer.sampler.drop_last = False
    paid = [buffer.sample()["next", "reward"].sum().item() for _ in range(-(-len(frames) // 64))]
    data = load(FOLDER / name)
    returns = data.episodes["undiscounted_return"][data.episodes["chunk"] == 1]
    assert sum(paid) == pytest.approx(returns.sum(), rel=1e-4)


def replay(data, policy, part):
    """Give a part's recorded actions to the environment with its seed; compares every step of its episodes.

    Another processor than the one that recorded rounds differently in the last digits.
    """
    chosen = np.flatnonzero((data.episodes["policy"] == policy) & (data.episodes["part"] == part))
    seed, batch = int(data.episodes["seed"][chosen[0]]), data.settings["batch"]
    env = data.make_env(batch, seed)
    env.set_seed(seed)
    frame = env.reset()
    transitions = data.storage(reward_terms=True)[:]
    own = {int(number): transitions[transitions["episode"] == int(number)] for number in chosen}
    rows = {number: int(data.episodes["environment"][number]) for number in own}
    compared = 0
    for step in range(int(data.episodes["length"][chosen].max())):
        action = torch.zeros(batch, *entries.shape_of(entries.ACTION, data.sizes))
        going = [number for number in own if step < len(own[number])]
        for number in going:
            action[rows[number]] = own[number][entries.ACTION][step]
        frame = env.step(frame.set(entries.ACTION, action))
        at = torch.tensor([rows[number] for number in going])
        told = torch.stack([own[number][step] for number in going])
        for key, value in told.items(include_nested=True, leaves_only=True):
            if key not in (layout.EPISODE, layout.POLICY):
                exactly = not value.is_floating_point()
                torch.testing.assert_close(
                    frame[key][at],
                    value,
                    rtol=0.0 if exactly else 1e-4,
                    atol=0.0 if exactly else 1e-5,
                    msg=lambda text, step=step, key=key: f"{key} after {step} steps: {text}",
                )
        compared += len(going)
        frame = step_mdp(frame)
    assert compared == data.episodes["length"][chosen].sum()
    return compared


@pytest.mark.parametrize("name", NAMES)
def test_recorded_actions_give_the_recorded_steps_again(name, one_thread):
    assert replay(load(FOLDER / name), policy=2, part=0) > 500


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_all_recorded_actions_give_the_recorded_steps_again(name, one_thread):
    data = load(FOLDER / name)
    parts = sorted(set(zip(data.episodes["policy"].tolist(), data.episodes["part"].tolist(), strict=True)))
    assert sum(replay(data, *part) for part in parts) == data.transitions


def test_the_page_has_the_bytes_of_the_released_sets():
    page = (ROOT / "docs/datasets.md").read_text()
    row = r"^\| (both observations|in the released files)[^|]*\| (\d+ \| \d+) \|$"
    rows = dict(re.findall(row, page, re.MULTILINE))
    sets = [load(FOLDER / name) for name in NAMES]
    plain = [sheet.plain_bytes(data.folder, data.sizes) for data in sets]
    stored = [sum(path.stat().st_size for path in data.folder.glob("*.tdz")) / data.transitions for data in sets]
    assert rows["both observations"] == " | ".join(map(str, plain))
    assert rows["in the released files"] == " | ".join(f"{size:.0f}" for size in stored)


def test_the_table_of_clones_is_made_of_the_committed_episodes():
    path = ROOT / "experiments/datasets.py"
    specification = importlib.util.spec_from_file_location("released_datasets", path)
    script = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(script)
    page = (ROOT / "docs/datasets.md").read_text()
    assert script.page(page) == page
    for name in (script.ORIGINAL, *script.CLONES):
        folder = FOLDER / "cloned" / name
        lines = (folder / "episodes.csv").read_text().splitlines()
        column = lines[0].split(",").index("success")
        successes = [line.split(",")[column] == "True" for line in lines[1:]]
        summary = json.loads((folder / "summary.json").read_text())
        assert np.mean(successes) == pytest.approx(summary["metrics"]["success_rate"]["mean"])
