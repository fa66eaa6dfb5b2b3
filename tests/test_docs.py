import os
import re
import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest
import yaml
from omegaconf import OmegaConf

from conftest import TASKS
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
    summary = (ROOT / "experiments/trained/basic/softgm/seed0/summary.json").read_text()
    (stated,) = re.findall(r"success rate +([0-9.]+)  \[", readme)
    assert f'"mean": {float(stated)}' in summary


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
    inherited = {} if task in ("basic", "structured", "wall") else tables["wall"]
    assert tables[SHARED] | inherited | tables[task] == settings_of(task)


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
    pages, module = tmp_path / "docs", tmp_path / "src/softgm_bench/wrong.py"
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
