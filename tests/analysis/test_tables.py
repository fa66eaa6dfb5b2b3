"""When tables rank and mark, and what they say where they may not."""

import pytest

from made_up_runs import write_run
from softgm_bench.analysis import latex, tables
from softgm_bench.analysis.document import Document, Section
from softgm_bench.analysis.pools import newest, pool_runs
from softgm_bench.analysis.runs import find
from softgm_bench.analysis.statistics import Bootstrap

LABELS = ("ippo", "mappo", "softgm", "softgm_paper")
BOOTSTRAP = Bootstrap(resamples=500, seed=0)


def write(root, seeds=3, frames=2_000_000):
    for seed in range(seeds):
        write_run(root, "wall", "softgm", seed, success=(0.99, 0.85, 0.97)[seed], count=400)
        write_run(root, "wall", "mappo", seed, success=0.5, count=400, frames=frames)
        write_run(root, "wall", "ippo", seed, success=(0.97, 0.78, 0.95)[seed], count=400)
    write_run(root / "paper", "wall", "softgm", 0, success=0.2, recipe="paper")


def rows(root):
    table = tables.table_one("wall", pool_runs(newest(find(root).runs)[0]), LABELS, BOOTSTRAP)
    names = [column.name for column in table.columns]
    return {row[0].text: dict(zip(names, row, strict=True)) for row in table.rows}, table


def test_three_seeds_at_equal_frames_are_ranked_and_what_differs_from_softgm_is_marked(tmp_path):
    write(tmp_path)
    found, table = rows(tmp_path)
    assert {name: row["rank"].text for name, row in found.items()} == {
        "SoftGM": "1",
        "IPPO": "2",
        "MAPPO": "3",
        "SoftGM, paper": "not ranked",
    }
    assert found["SoftGM, paper"]["recipe"].text == "paper"
    place = [column.name for column in table.columns].index("ours")
    shares = {row[0].text: row[place] for row in table.rows}
    assert [shares[name].strong for name in ("SoftGM", "IPPO", "MAPPO")] == [True, False, False]
    assert [shares[name].text.endswith(tables.SIGNIFICANT) for name in ("SoftGM", "IPPO", "MAPPO")] == [
        False,
        False,
        True,
    ]
    assert any(note.startswith(tables.SIGNIFICANT) for note in table.notes)


@pytest.mark.parametrize(
    ("settings", "rank", "note"),
    [
        ({"seeds": 2}, "2 of 3 seeds", "0 of 3 have the seeds."),
        ({"frames": 3_500_000}, "—", "3 of 3 have the seeds, with unequal frames."),
    ],
)
def test_otherwise_the_place_of_the_rank_and_a_note_say_what_is_missing(tmp_path, settings, rank, note):
    write(tmp_path, **settings)
    found, table = rows(tmp_path)
    assert {row["rank"].text for name, row in found.items() if name != "SoftGM, paper"} == {rank}
    assert not any(cell.strong or cell.text.endswith(tables.SIGNIFICANT) for row in table.rows for cell in row)
    assert any(one.endswith(note) for one in table.notes)


def test_tables_for_a_paper_of_ones_own_leave_out_what_was_not_run_and_are_not_scaled(tmp_path):
    write(tmp_path)
    pools = pool_runs(newest(find(tmp_path).runs)[0])
    table = tables.table_one("wall", pools, [*LABELS, "masac"], BOOTSTRAP)
    files = latex.for_papers(Document("Report", [Section("Part", [table])]))
    assert set(files) == {"table1.tex", "table1_compact.tex", "table2.tex", "table2_compact.tex"}
    assert files["table2.tex"] == "% nothing was run\n"
    for name in ("table1.tex", "table1_compact.tex"):
        text = files[name]
        assert "resizebox" not in text
        assert "MASAC" not in text
        (layout,) = (line for line in text.splitlines() if line.startswith(r"\begin{tabular}"))
        columns = layout.count("l", len(r"\begin{tabular}")) + layout.count("r", len(r"\begin{tabular}"))
        (softgm,) = (line for line in text.splitlines() if line.startswith("SoftGM &"))
        assert softgm.count("&") == columns - 1 == (4 if "compact" in name else 12)
        assert text.count(r"\begin{") == text.count(r"\end{") == 2
