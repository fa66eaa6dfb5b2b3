"""Make the paper's tables and figures from runs: ``softgm-bench report RUNS_FOLDER [key=value ...]``.

Writes ``report.md``, ``report.tex``, ``report.html`` (needs no other file), ``figures/`` for the first two, the paper's
two tables for a paper of your own (``table1.tex``, ``table2.tex`` and both ``_compact``, for one column),
``marl_eval.json`` and ``made_with.json``. The same runs give the same bytes.

Settings:
  out=report          folder to write
  evaluations=null    another folder with evaluations of the runs' policies; those below RUNS_FOLDER are found anyway
  resamples=5000      of the bootstrap
  seed=0              of the bootstrap
"""

import json
import sys
from dataclasses import dataclass
from pathlib import Path

from softgm_bench.command import parse, run
from softgm_bench.errors import UserError
from softgm_bench.progress import tracked
from softgm_bench.storage.files import to_json, write_atomically


@dataclass
class Options:
    """Settings of the command; see the module's text."""

    out: str = "report"
    evaluations: str | None = None
    resamples: int = 5000
    seed: int = 0


def report(arguments: list[str]) -> None:
    """Read, build and write.

    Raises:
        UserError: a setting that makes no sense, no such folder, or no finished run below it.
    """
    root, options, _ = parse(arguments, Options, "folder of runs")
    if options.resamples < 100:
        raise UserError(f"resamples={options.resamples}: it must be at least 100")
    if options.seed < 0:
        raise UserError(f"seed={options.seed}: it must be 0 or more")
    from softgm_bench.analysis.runs import find

    found = find(root, *([Path(options.evaluations)] if options.evaluations is not None else []))
    if not found.runs:
        known = f"; {found.problems[0].folder} is {found.problems[0].reason}" if found.problems else ""
        raise UserError(f"{root}: no finished run below it; a run's folder holds config.yaml and summary.json{known}")
    try:
        import matplotlib
    except ImportError as error:
        raise UserError("a report needs matplotlib: pip install '.[report]'") from error
    from softgm_bench.analysis import html, latex, markdown
    from softgm_bench.analysis.build import build
    from softgm_bench.analysis.marl_eval import export
    from softgm_bench.analysis.pools import newest
    from softgm_bench.analysis.statistics import Bootstrap

    out = Path(options.out)
    (out / "figures").mkdir(parents=True, exist_ok=True)  # before the work whose result it takes
    document = build(
        found,
        Bootstrap(options.resamples, options.seed),
        lambda titles: tracked(titles, "tables and figures", len(titles), "sections"),
    )
    made_with = {"matplotlib": matplotlib.__version__, "resamples": options.resamples, "seed": options.seed}
    files = {
        "report.md": markdown.render(document).encode(),
        "report.tex": latex.render(document).encode(),
        **{name: text.encode() for name, text in latex.for_papers(document).items()},
        "report.html": html.render(document).encode(),
        "marl_eval.json": (to_json(export(newest(found.runs)[0]), indent=1) + "\n").encode(),
        "made_with.json": (json.dumps(made_with, indent=1) + "\n").encode(),
    }
    for figure in document.figures:
        files[f"figures/{figure.key}.svg"] = figure.svg.encode()
        files[f"figures/{figure.key}.pdf"] = figure.pdf
    for name, content in files.items():
        write_atomically(out / name, content)
    skipped = f", {len(found.problems)} left out" if found.problems else ""
    counted = f"{len(found.runs)} runs, {len(found.evaluations)} evaluations{skipped}"
    print(f"{counted}; written: {out / 'report.html'} and others")


if __name__ == "__main__":
    sys.exit(run("report", __doc__, report))
