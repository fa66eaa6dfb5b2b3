"""What MkDocs is told beyond ``mkdocs.yml``: the API's pages, and files of the repository that pages link to.

The pages in ``docs/`` are read on GitHub as well, where a link may leave the folder (``../benchmarks/results``).
The site takes every file that is linked so with it, below ``repository/``; of a folder it lists the content. In such a
file, a link into ``docs/`` leads to the site's page.
"""

import re
from pathlib import Path, PurePosixPath
from posixpath import normpath, relpath
from typing import Any

from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "src" / "softgm_bench"
LINK = re.compile(r"(\]\()((?!/)[^)\s#:]+)(#[^)\s]*)?(\))")  # of Markdown, within a site or a repository
FENCE = re.compile(r"^(```|~~~).*?^\1\s*$", re.DOTALL | re.MULTILINE)
COPIES = "repository"


def on_config(config: Any) -> Any:
    """Put the API's pages into the navigation."""
    config.nav = [{"API": _api_navigation()} if entry == {"API": "api/"} else entry for entry in config.nav]
    return config


# What others may build on; the rest of the package may change without notice. Tests and examples of these pages import
# nothing else.
PUBLIC = {
    "": ["softgm_bench", "api", "errors", "plugins", "config", "config.schema"],
    "envs": [
        "envs",
        "envs.soft_arm",
        "envs.interface",
        "envs.entries",
        "envs.tasks",
        "envs.tasks.base",
        "envs.perturbation",
        "envs.reward",
    ],
    "rod": [
        "rod.parameters",
        "rod.state",
        "rod.actuation",
        "rod.bodies",
        "rod.randomise",
        "rod.backend",
        "rod.numba_backend",
        "rod.torch_backend",
        "rod.cuda_backend",
        "rod.pyelastica_backend",
    ],
    "models": ["models", "models.registry", "models.graph", "models.softgm", "models.mlp", "models.heads"],
    "algorithms": ["algorithms", "algorithms.registry"],
    "episodes": [
        "episodes.policy",
        "episodes.evaluation",
        "episodes.interventions",
        "episodes.summary",
        "episodes.recording",
        "episodes.trajectory",
        "episodes.replay",
    ],
    "datasets": ["datasets.reading", "datasets.layout", "datasets.minari"],
    "render": ["render.still", "render.video", "render.html"],
    "adapters": ["adapters.pettingzoo", "adapters.player", "adapters.gymnasium_vector"],
}


def _modules() -> list[str]:
    """Public modules of the package by dotted name, those that this checkout has."""
    return [module for room in PUBLIC for module in _room(room)]


def _room(room: str) -> list[str]:
    names = [PACKAGE.name if name == PACKAGE.name else f"{PACKAGE.name}.{name}" for name in PUBLIC[room]]
    return [name for name in names if _source(name).exists()]


def _source(module: str) -> Path:
    path = PACKAGE.parent.joinpath(*module.split("."))
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")


def _page(module: str) -> str:
    """Path of a module's page."""
    return f"api/{module}.md"


def _api_navigation() -> list[Any]:
    """The package's own public modules, then a section for each of its rooms."""
    pages = {room: [{module.rpartition(".")[2]: _page(module)} for module in _room(room)] for room in PUBLIC}
    own = pages.pop("")
    return [*own, *({room: of_room} for room, of_room in pages.items() if of_room)]


def on_files(files: Files, config: Any) -> Files:
    """Add a page for each public module and what pages link to outside of ``docs/``."""
    for module in _modules():
        files.append(File.generated(config, _page(module), content=f"::: {module}\n"))
    waiting = [file for file in files.documentation_pages() if not file.src_uri.startswith("api/")]
    while waiting:
        page = waiting.pop()
        for path in _links_outside(page.content_string, _home(page.src_uri)):
            copy = _copy(path, config)
            if copy is not None and copy.src_uri not in files.src_uris:
                files.append(copy)
                if copy.is_documentation_page():
                    waiting.append(copy)
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Turn links to files of the repository to where the site has them."""
    uri = page.file.src_uri

    def turned(match: re.Match[str]) -> str:
        before, target, anchor, after = match.groups(default="")
        path = normpath(f"{_home(uri)}/{target}")
        if path.startswith("../"):
            return match[0]  # MkDocs warns of it
        return f"{before}{relpath(_uri(path), str(PurePosixPath(uri).parent))}{anchor}{after}"

    return "".join(part if fenced else LINK.sub(turned, part) for part, fenced in _outside_of_code(markdown))


def _outside_of_code(markdown: str) -> list[tuple[str, bool]]:
    """The text in pieces, each with whether it is a fenced block of code."""
    pieces, end = [], 0
    for match in FENCE.finditer(markdown):
        pieces += [(markdown[end : match.start()], False), (match[0], True)]
        end = match.end()
    return [*pieces, (markdown[end:], False)]


def _home(uri: str) -> str:
    """The folder of the repository in which a page's links begin."""
    folder = str(PurePosixPath(uri).parent)
    return normpath(folder.removeprefix(COPIES).lstrip("/") or ".") if folder.startswith(COPIES) else f"docs/{folder}"


def _links_outside(markdown: str, home: str) -> list[str]:
    """Paths in the repository, outside of ``docs/``, that a page links to."""
    text = "".join(part for part, fenced in _outside_of_code(markdown) if not fenced)
    paths = [normpath(f"{home}/{match[2]}") for match in LINK.finditer(text)]
    return [path for path in paths if not path.startswith(("docs/", "../"))]


def _uri(path: str) -> str:
    """Where the site has a file of the repository, or the list of a folder's content."""
    if path.startswith("docs/"):
        return path.removeprefix("docs/")
    return f"{COPIES}/{path}/index.md" if (ROOT / path).is_dir() else f"{COPIES}/{path}"


def _copy(path: str, config: Any) -> File | None:
    """A file of the repository for the site, or a page that lists a folder; None where there is nothing."""
    source = ROOT / path
    if source.is_dir():
        return File.generated(config, _uri(path), content=_listing(path))
    if source.is_file():
        return File.generated(config, _uri(path), abs_src_path=str(source))
    return None  # MkDocs warns of the link


def _listing(path: str) -> str:
    """A page that says what a folder of the repository holds."""
    files = sorted(file for file in (ROOT / path).rglob("*") if file.is_file())
    if not files:
        raise PluginError(f"{path} is linked to and is empty")
    rows = [f"| `{file.relative_to(ROOT / path).as_posix()}` | {file.stat().st_size:,} |" for file in files]
    return "\n".join(
        [f"# {path}", "", "In the repository; size in bytes.", "", "| file | size |", "| --- | ---: |", *rows]
    )
