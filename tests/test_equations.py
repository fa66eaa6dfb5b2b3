import re
from importlib import import_module
from pathlib import Path

import pytest

PAGE = (Path(__file__).parents[1] / "docs/equations.md").read_text()
PLACES = [(file, name) for file, name in re.findall(r"\| `([\w/]+\.py)` \| `([\w.]+)` \|", PAGE)]
SUBSTEP = [
    (file or "rod/torch_backend.py", name)
    for row in PAGE.partition("| equation | function |")[2].splitlines()
    for name, file in re.findall(r"`(\w+)`(?: in `([\w/]+\.py)`)?", row)
]


@pytest.mark.parametrize(("file", "name"), sorted({*PLACES, *SUBSTEP}))
def test_every_function_that_the_page_names_stands_in_the_file_that_it_names(file, name):
    module = import_module("softgm_bench." + file.removesuffix(".py").replace("/", "."))
    found = module
    for part in name.split("."):
        found = getattr(found, part)
    assert getattr(found, "__module__", module.__name__) == module.__name__ or file.endswith("entries.py")


def test_the_page_names_every_numbered_part_of_the_method():
    assert len(PLACES) >= 25
    assert len(SUBSTEP) >= 8
