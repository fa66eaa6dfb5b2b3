import json
import os
import re
import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import yaml
from omegaconf import OmegaConf

from every_task import TASKS
from softgm_bench.config import compose_untyped

ROOT = Path(__file__).parents[1]
SNIPPETS = [
    pytest.param(code, id=f"{page.name}-{number}")
    for page in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))
    for number, code in enumerate(re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL))
]


@pytest.mark.parametrize("code", SNIPPETS)
def test_snippets_of_the_documentation_run(code):
    exec(code, {})


def test_the_committed_run_has_the_success_that_the_readme_states():
    readme = (ROOT / "README.md").read_text()
    ((stated, low, high),) = re.findall(r"^success rate +([0-9.]+)  \[([0-9.]+), ([0-9.]+)\]", readme, re.MULTILINE)
    summary = json.loads((ROOT / "experiments/trained/basic/softgm/seed0/summary.json").read_text())
    success = summary["final_evaluation"]["success_rate"]
    assert [f"{success[key]:.3f}" for key in ("mean", "low", "high")] == [stated, low, high]


def test_the_results_of_the_readme_are_those_of_the_committed_runs():
    readme = (ROOT / "README.md").read_text().partition("## Results")[2].partition("\n## ")[0]
    rows = re.findall(
        r"^\| (?:`(\w+)`[^|]*)?\| (\w+)([^|]*) \| ([0-9.]+) \| \[([0-9.]+), ([0-9.]+)\] \|$", readme, re.MULTILINE
    )
    assert len(rows) == 14
    task, three = "", False
    for named, algorithm, told, *stated in rows:
        task = named or task
        label = algorithm.lower() + ("_no_stage1" if "without stage 1" in told else "")
        seeds = sorted((ROOT / "experiments" / "campaign" / task / label).glob("seed*/summary.json"))
        if not seeds or "as the recipe was" in told:
            seeds = [ROOT / "experiments" / "trained" / task / label / "seed0" / "summary.json"]
        success = [json.loads(path.read_text())["final_evaluation"]["success_rate"] for path in seeds]
        if len(success) < 3:
            expected = [success[0][key] for key in ("mean", "low", "high")]
        else:
            expected = [np.mean([one["mean"] for one in success])]
            page = (ROOT / "docs" / "results.md").read_text().partition("<!-- campaign seeds -->")[2]
            expected += re.search(
                rf"^\| `{task}` \| {label} \|.*? \[([0-9.]+), ([0-9.]+)\]", page, re.MULTILINE
            ).groups()
        assert [f"{float(number):.3f}" for number in expected] == stated, (task, algorithm)
        three = "three seeds" in told or (three and "likewise" in told)
        assert three == (len(success) == 3), (task, algorithm)
        for number in re.findall(r"with seed 1 it has ([0-9.]+)", told):
            assert f"{success[1]['mean']:.3f}" == number


def test_the_hours_that_the_papers_table_takes_are_those_of_the_measured_rates():
    measured = json.loads((ROOT / "benchmarks/results/training_zen3.json").read_text())["rows"]
    seconds = {"PPO": 0.0, "off policy": 0.0}
    for row in measured:
        frames = compose_untyped([f"task={row['task']}"]).experiment.total_frames
        kind = "PPO" if row["algo"] in ("softgm", "ippo", "mappo") else "off policy"
        seconds[kind] += 3 * frames / row["frames_per_s"]
    told = f"take {sum(seconds.values()) / 3600:.0f} hours, {seconds['off policy'] / 3600:.0f} of them with the four"
    assert told in (ROOT / "docs/sweeps.md").read_text()


def test_the_launches_that_the_page_on_the_environment_tells_are_those_that_were_counted():
    counts = {}
    for when in ("operations_before_kernels", "operations"):
        for row in json.loads((ROOT / f"benchmarks/results/{when}.json").read_text())["rows"]:
            if row["part"] == "all":
                counts[row["what"], row["task"], when] = str(row["operations"])
    page = (ROOT / "docs/environment.md").read_text()
    for told, what in (
        ("a step of the environment with its resets", "environment step"),
        ("a call of SoftGM's policy", "policy call"),
        ("a gradient step of PPO with SoftGM", "gradient step"),
    ):
        cells = [
            counts[what, task, when]
            for task in ("basic", "wall")
            for when in ("operations_before_kernels", "operations")
        ]
        assert f"| {told} | {' | '.join(cells)} |" in page


def test_the_readme_is_short_and_has_no_link_that_leads_nowhere():
    readme = (ROOT / "README.md").read_text()
    assert readme.count("\n") <= 120
    for target in re.findall(r"\]\(([^)#]+)[^)]*\)", readme):
        assert target.startswith(("https://", "../../actions/")) or (ROOT / target).exists(), target


ROW = re.compile(r"^\| `([\w.]+)` \| ([^|]+?) \|", re.MULTILINE)
SHARED = "All tasks"  # the section of the settings that tasks share


def task_tables():
    """Settings by section of the tasks' page, values read as YAML."""
    sections = re.split(r"^## ", (ROOT / "docs/tasks.md").read_text(), flags=re.MULTILINE)[1:]
    tables = {section.splitlines()[0]: dict(ROW.findall(section)) for section in sections}
    return {title: {key: yaml.safe_load(value) for key, value in rows.items()} for title, rows in tables.items()}


def settings_of(task):
    """All settings of a task by dotted name; the curriculum has a page of its own."""
    composed = OmegaConf.to_container(compose_untyped([f"task={task}"]).task, resolve=True)
    for group in ("actuation", "reward"):
        composed |= {f"{group}.{key}": value for key, value in composed.pop(group).items()}
    return {key: value for key, value in composed.items() if key not in ("name", "curriculum")}


@pytest.mark.parametrize("task", TASKS)
def test_the_tables_of_a_task_are_its_settings(task):
    tables = task_tables()
    parent = "structured" if task == "swinging_posts" else "wall"
    inherited = {} if task in ("basic", "structured", "wall") else tables[parent]
    assert tables[SHARED] | inherited | tables[task] == settings_of(task)


def test_the_api_reference_has_what_pages_and_examples_import_and_no_private_room():
    hooks = (ROOT / "docs/hooks.py").read_text()
    (listed,) = re.findall(r"^PUBLIC = (\{.*?^\})", hooks, re.MULTILINE | re.DOTALL)
    names = {name for room in eval(listed).values() for name in room}
    pages = [ROOT / "README.md", *(ROOT / "docs").glob("*.md"), *(ROOT / "examples").glob("*.py")]
    text = "".join(page.read_text() for page in pages)
    for module, imported in re.findall(r"^from softgm_bench(?:\.([\w.]+))? import ([\w, ]+)", text, re.MULTILINE):
        for name in imported.split(", "):
            inner = f"{module}.{name}".strip(".")
            assert inner in names or (module or "softgm_bench") in names, inner
    assert not [name for name in names if name.split(".")[0] in ("upstream", "storage", "runs", "sweeps", "analysis")]
    for name in names - {"softgm_bench"}:
        path = ROOT / "src/softgm_bench" / name.replace(".", "/")
        assert path.with_suffix(".py").is_file() or path.is_dir(), name


def site(root, target):
    """Build the site of a checkout the way `make docs` does."""
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--config-file", root / "mkdocs.yml"]
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    return subprocess.run([*command, "--site-dir", target], capture_output=True, text=True, env=environment)


needs_mkdocs = pytest.mark.skipif(
    any(find_spec(name) is None for name in ("mkdocs", "material", "mkdocstrings_handlers")),
    reason="needs softgm-bench[docs]",
)


@needs_mkdocs
@pytest.mark.slow
def test_the_site_builds_without_warnings(tmp_path):
    built = site(ROOT, tmp_path)
    assert built.returncode == 0, built.stderr
    assert "kinematic state of" in (tmp_path / "api/softgm_bench.rod.state.html").read_text()
    # what a page links to outside of docs/ comes along
    assert (tmp_path / "repository/benchmarks/results/models.json").exists()
    assert "repository/benchmarks/results/models.json" in (tmp_path / "models.html").read_text()
    # nothing is fetched while a page is read
    assert not re.search(r'(src="|<link[^>]+href=")https?:', (tmp_path / "index.html").read_text())


@needs_mkdocs
@pytest.mark.slow
def test_the_site_is_refused_for_every_kind_of_mistake(tmp_path):
    """One checkout with all of them, so that it is built once."""
    pages, module = tmp_path / "docs", tmp_path / "src/softgm_bench/api.py"
    pages.mkdir()
    module.parent.mkdir(parents=True)
    (module.parent / "__init__.py").touch()
    for name in ("hooks.py", "site.css"):
        shutil.copy(ROOT / "docs" / name, pages)
    config = (ROOT / "mkdocs.yml").read_text()
    (tmp_path / "mkdocs.yml").write_text(
        re.sub(r"nav:\n.*?\n(?=\S)", "nav: [index.md, API: api/]\n", config, flags=re.DOTALL)
    )
    links = "[a](gone.md) [b](#nowhere) [c](../lost.json) ![d](missing.png)"
    (pages / "index.md").write_text(f"# Title\n\n{links}\n\n```\n[e](in_code.md)\n```\n")
    (pages / "forgotten.md").write_text("# Not in the navigation\n")
    module.write_text(
        '"""Of nothing."""\n\n\ndef f(x: int) -> int:\n    """It.\n\n    Args:\n        y: not there.\n    """\n'
    )
    built = site(tmp_path, tmp_path / "site")
    assert built.returncode == 1
    for mistake in ("'gone.md'", "'#nowhere'", "lost.json'", "'missing.png'", "forgotten.md", "Parameter 'y'"):
        assert mistake in built.stderr
    assert "in_code.md" not in built.stderr
