"""Names as a reader knows them, and numbers as tables print them."""

from collections.abc import Iterable, Sequence

from softgm_bench.analysis.runs import Evaluation

TASK_TITLES = {"basic": "Basic", "structured": "Structured obstacles", "wall": "Wall with hole"}
CONDITION_TITLES = {
    "none": "Nominal",
    "noise": "Noise",
    "section_failure": "Section failure",
    "disturbance": "Disturbance",
}


# Models that are methods of their own. Trained by the algorithm named softgm, they are what is compared with SoftGM.
RIVALS = {
    "informarl": "InforMARL",
    "section_transformer_all": "All-section transformer",
    "section_transformer": "Section transformer",
}


def algorithm(label: str) -> str:
    """Name an algorithm, e.g. ``SoftGM without stage 1``, ``MAPPO, softgm`` or ``InforMARL``."""
    base, _, rest = label.partition("_")
    name = "SoftGM" if base == "softgm" else base.upper()
    rival = next((model for model in RIVALS if rest.startswith(model)), None)
    if base == "softgm" and rival is not None:
        name, rest = RIVALS[rival], rest.removeprefix(rival).removeprefix("_")
    for stage in ("1", "2"):
        if rest.startswith(f"no_stage{stage}"):
            name += f" without stage {stage}"
            rest = rest.removeprefix(f"no_stage{stage}").removeprefix("_")
    if rest.startswith("remember"):
        name += " that remembers"
        rest = rest.removeprefix("remember").removeprefix("_")
    return f"{name}, {rest}" if rest else name


def task(name: str) -> str:
    """Name a task."""
    return TASK_TITLES.get(name, name)


def perturbation(text: str) -> str:
    """Name a condition, with its parameters as they are."""
    name, _, parameters = text.partition(" ")
    return f"{CONDITION_TITLES.get(name, name)} {parameters}".rstrip()


def spread(values: Sequence[float], digits: int) -> str:
    """Write a mean and a standard deviation."""
    return f"{values[0]:,.{digits}f} ± {values[1]:,.{digits}f}"


def percent(value: float) -> str:
    """Write a share as per cent."""
    return f"{100 * value:.1f}"


def percent_interval(bounds: Sequence[float]) -> str:
    """Write bounds of a share as per cent."""
    return f"[{100 * bounds[0]:.1f}, {100 * bounds[1]:.1f}]"


def span(values: list[int], unit: float = 1.0, digits: int = 0) -> str:
    """Write a number, or the smallest and the largest of several."""
    low, high = (f"{value / unit:,.{digits}f}" for value in (min(values), max(values)))
    return low if low == high else f"{low}–{high}"


def actions(evaluations: Iterable[Evaluation]) -> str:
    """Say how actions were taken in them."""
    kinds = {"deterministic" if evaluation.deterministic else "sampled" for evaluation in evaluations}
    return " and ".join(sorted(kinds))
