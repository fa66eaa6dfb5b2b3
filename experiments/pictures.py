"""Draw the pictures of docs/pictures from the policies in experiments/policies: ``python experiments/pictures.py``."""

from pathlib import Path

from softgm_bench.render.__main__ import main

HERE = Path(__file__).parent
PICTURES = HERE.parent / "docs" / "pictures"
# Policy, files, settings. The seeds are chosen to show something: they are no measure of success.
SCENES = (
    ("basic_softgm", ("basic.png",), ("seed=0",)),
    ("structured_softgm", ("structured.png",), ("seed=0",)),
    ("wall_softgm", ("wall.png",), ("seed=3",)),
    ("wall_softgm", ("wall_attention.png",), ("seed=3", "attention=true", "step=13", "distance=1.9")),
    ("wall_softgm", ("wall_narrow.png",), ("task=wall_narrow", "seed=4")),
    ("wall_softgm", ("wall_fixed.png",), ("task=wall_fixed", "seed=8")),
    ("wall_softgm", ("wall_search.png",), ("task=wall_search", "seed=3")),
    ("wall_softgm", ("wall_decoy.png",), ("task=wall_decoy", "seed=6")),
    ("wall_sense_softgm", ("wall_sense.png",), ("seed=2",)),
    ("wall_sense_softgm", ("wall_sense.webp",), ("seed=2", "width=480", "height=360", "fps=20")),
    ("wall_softgm", ("wall.mp4", "wall.html"), ("seed=3",)),
    ("wall_softgm", ("wall.webp",), ("seed=3", "width=480", "height=360", "fps=20")),
)

if __name__ == "__main__":
    for policy, names, settings in SCENES:
        files = ",".join(str(PICTURES / name) for name in names)
        main([str(HERE / "policies" / f"{policy}.pt"), f"out={files}", *settings])
