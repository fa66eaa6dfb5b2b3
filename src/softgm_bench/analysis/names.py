"""Names as a reader knows them, and numbers as tables print them."""

TASK_TITLES = {"basic": "Basic", "structured": "Structured obstacles", "wall": "Wall with hole"}
CONDITION_TITLES = {
    "none": "Nominal",
    "noise": "Noise",
    "section_failure": "Section failure",
    "disturbance": "Disturbance",
}


def algorithm(label: str) -> str:
    """An algorithm's name, e.g. ``SoftGM without stage 1`` or ``MAPPO, softgm``."""
    base, _, rest = label.partition("_")
    name = "SoftGM" if base == "softgm" else base.upper()
    for stage in ("1", "2"):
        if rest.startswith(f"no_stage{stage}"):
            name += f" without stage {stage}"
            rest = rest.removeprefix(f"no_stage{stage}").removeprefix("_")
    return f"{name}, {rest}" if rest else name


def task(name: str) -> str:
    """A task's name."""
    return TASK_TITLES.get(name, name)


def perturbation(text: str) -> str:
    """A condition's name with its parameters as they are."""
    name, _, parameters = text.partition(" ")
    return f"{CONDITION_TITLES.get(name, name)} {parameters}".rstrip()


def spread(values: tuple[float, float] | None, digits: int) -> str | None:
    """Mean and standard deviation; None stays None."""
    return None if values is None else f"{values[0]:,.{digits}f} ± {values[1]:,.{digits}f}"


def percent(value: float) -> str:
    """A share as per cent."""
    return f"{100 * value:.1f}"


def percent_interval(bounds: tuple[float, float]) -> str:
    """Bounds of a share as per cent."""
    return f"[{100 * bounds[0]:.1f}, {100 * bounds[1]:.1f}]"


def span(values: list[int], unit: float = 1.0, digits: int = 0) -> str:
    """A number, or the smallest and the largest of several."""
    low, high = (f"{value / unit:,.{digits}f}" for value in (min(values), max(values)))
    return low if low == high else f"{low}–{high}"
