import re
from pathlib import Path

import pytest

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
