"""The rod against solutions that we did not simulate: measures, writes a JSON file and one figure for each study.

``python benchmarks/validation.py`` runs all studies (a few minutes, mostly compilation); ``--only float32`` one of
them. Results go to ``benchmarks/results/validation.json``, figures to ``docs/validation_<study>.png``. The solutions
themselves are in ``tests/rod/analytical.py``.
"""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import elastica
import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "rod"))
import record
import validation_figures
from analytical import (
    Energies,
    arc,
    discrete_cantilever_tip,
    end_couple,
    nodes,
    relax,
    state_of,
    stiffness,
    stretch,
    timoshenko_tip,
    tip_force_equilibrium,
    tip_load,
)
from parity_cases import CASES, CPU_BACKENDS, Case

from softgm_bench.rod.backend import make_backend
from softgm_bench.rod.parameters import RodParameters
from softgm_bench.rod.pyelastica_oracle import Loads, as_cylinders, build
from softgm_bench.rod.state import Cylinders, RodState, straight_rods

Result = dict[str, Any]
AZIMUTH = 0.3  # of the plane in which arms bend, rad: no axis of the world's


def settling(n_elements: int = 60, dt: float = 4e-4) -> RodParameters:
    """An arm whose first bending mode is critically damped: equilibria do not depend on the damping."""
    return RodParameters(
        n_elements=n_elements, dt=dt, damping_protocol="uniform_damping_constant", damping_constant=4.0
    )


def short(values: np.ndarray) -> list[float]:
    """Four digits of each, for curves."""
    return [float(f"{value:.3e}") for value in values]


def no_couple(parameters: RodParameters) -> torch.Tensor:
    return torch.zeros(1, 3, parameters.n_elements, dtype=torch.float64)


def difference(first: RodState, second: RodState) -> float:
    return (first.position - second.position).abs().max().item()


def cantilever() -> Result:
    """Tip of an arm under a force across it: a small one for each number of elements, and three large ones."""
    load, rows = 1e-4, []
    for n in (11, 20, 40, 60, 100):
        parameters = settling(n, 4e-4 if n <= 60 else 2e-4)
        tip = relax(parameters, force=tip_load(parameters, (load, 0.0, 0.0))).position[0, 0, -1].item()
        beam, discrete = timoshenko_tip(parameters, load), discrete_cantilever_tip(parameters, load)
        shorter = timoshenko_tip(parameters, load, stiff_length=0.5 / n)
        rows.append(
            {
                "elements": n,
                "tip_m": tip,
                "relative_to_discrete": tip / discrete - 1.0,
                "relative_to_timoshenko": tip / beam - 1.0,
                "relative_to_timoshenko_half_an_element_stiff": tip / shorter - 1.0,
            }
        )
    large = []
    for across, along in ((1.0, 0.0), (5.0, -1.0), (5.0, 200.0)):
        parameters = settling()
        force = tip_load(parameters, (across * np.cos(AZIMUTH), across * np.sin(AZIMUTH), along))
        expected = state_of(parameters, tip_force_equilibrium(parameters, across, along), AZIMUTH)
        found = relax(parameters, force=force)
        large.append({"across_N": across, "along_N": along, "difference_m": difference(found, expected)})
    return {"load_N": load, "small": rows, "large": large}


def axial_stretch() -> Result:
    """Tip of an arm that is pulled along its axis."""
    parameters, rows = settling(), []
    for share in (-0.0004, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6):
        force = share * stiffness(parameters).stretch
        height = relax(parameters, force=tip_load(parameters, (0.0, 0.0, force))).position[0, 2].numpy()
        expected = stretch(parameters, force) * np.linspace(0.0, 1.0, parameters.n_nodes)
        rows.append(
            {
                "force_over_EA": share,
                "tip_m": float(height[-1]),
                "closed_form_m": float(expected[-1]),
                "difference_m": float(np.abs(height - expected).max()),
            }
        )
    return {"rows": rows}


def end_couples() -> Result:
    """Nodes of an arm under a couple at its end, and whether the backends stay in a full circle."""
    parameters, rows = settling(), []
    full_circle = 2.0 * np.pi * stiffness(parameters).bend / parameters.base_length
    for turns in (0.125, 0.25, 0.375, 0.5):
        couple = turns * full_circle
        found = relax(parameters, end_couple(parameters, couple))
        expected = state_of(parameters, arc(parameters, couple))
        rows.append(
            {
                "turns": turns,
                "couple_Nm": couple,
                "difference_m": difference(found, expected),
                "x_m": found.position[0, 0].tolist(),
                "z_m": found.position[0, 2].tolist(),
            }
        )
    undamped = RodParameters(damping_constant=0.0)
    circle = state_of(undamped, arc(undamped, full_circle), AZIMUTH)
    couple = end_couple(undamped, full_circle, AZIMUTH)
    moved = {
        name: difference(make_backend(name, undamped).control_step(circle, couple), circle) for name in CPU_BACKENDS
    }
    return {"rows": rows, "full_circle_moves_in_a_control_step_m": moved}


def total_energies(parameters: RodParameters, force: float, seconds: float) -> np.ndarray:
    """After every control step of an arm that is released from its equilibrium under a tip force, J."""
    state = state_of(parameters, tip_force_equilibrium(parameters, force, 0.0), AZIMUTH)
    rod, energies = make_backend("numba", parameters), Energies(parameters)
    totals = [sum(energies(state))]
    for _ in range(round(seconds / parameters.control_dt)):
        state = rod.control_step(state, no_couple(parameters))
        totals.append(sum(energies(state)))
    return np.array(totals)


def pyelastica_energies(parameters: RodParameters, force: float, seconds: float) -> np.ndarray:
    """The same, moved by PyElastica as well."""
    start = state_of(parameters, tip_force_equilibrium(parameters, force, 0.0), AZIMUTH)
    simulator, rod = build(parameters, Loads(np.zeros((3, parameters.n_elements))))
    simulator.finalize()
    rod.position_collection[...] = start.position[0].numpy()
    rod.director_collection[...] = start.director[0].numpy()
    stepper, now, totals = elastica.PositionVerlet(), np.float64(0.0), []
    for step in range(round(seconds / parameters.control_dt) + 1):
        for _ in range(parameters.substeps if step else 0):
            now = stepper.step(simulator, now, np.float64(parameters.dt))
        rod.compute_internal_forces_and_torques(now)
        kinetic = rod.compute_translational_energy() + rod.compute_rotational_energy()
        totals.append(kinetic + rod.compute_bending_energy() + rod.compute_shear_energy())
    return np.array(totals)


def energy() -> Result:
    """Total energy, by PyElastica's functions, over 40 s after a release without damping."""
    seconds, undamped = 40.0, RodParameters(damping_constant=0.0)
    half_step = RodParameters(damping_constant=0.0, dt=2e-4, substeps=200)

    def summary(totals: np.ndarray) -> Result:
        change = totals / totals[0] - 1.0
        trend = np.polyfit(np.linspace(0.0, seconds, len(change)), change, 1)[0] * seconds
        return {
            "start_J": float(totals[0]),
            "largest_change": float(np.abs(change).max()),
            "trend_over_run": float(trend),
            "change": short(change),
        }

    rows = []
    for force in (0.2, 1.0, 2.0):
        tip = float(nodes(undamped, tip_force_equilibrium(undamped, force, 0.0))[0][-1])
        finer = summary(total_energies(half_step, force, seconds))
        finer.pop("change")
        row = {"force_N": force, "tip_m": tip, **summary(total_energies(undamped, force, seconds))}
        rows.append(row | {"half_the_step": finer})
    far = 3.0
    damped = total_energies(RodParameters(), far, seconds)
    return {
        "control_dt_s": undamped.control_dt,
        "rows": rows,
        "far": {
            "force_N": far,
            "tip_m": float(nodes(undamped, tip_force_equilibrium(undamped, far, 0.0))[0][-1]),
            "ours": summary(total_energies(undamped, far, seconds)),
            "ours_half_the_step": summary(total_energies(half_step, far, seconds)),
            "pyelastica": summary(pyelastica_energies(undamped, far, seconds)),
            "with_the_arms_damping": {"largest_rise_of_a_control_step": float(np.diff(damped).max() / damped[0])},
        },
    }


def time_step() -> Result:
    """Error 0.4 s after the release of a bent arm for each size of the substep, against one 64 times finer."""
    steps = [4e-4 / 2**i for i in range(6)]

    def end(dt: float, damping: float, twisting: bool) -> torch.Tensor:
        parameters = RodParameters(n_elements=20, damping_constant=damping, dt=dt)
        start = state_of(parameters, tip_force_equilibrium(parameters, 1.0, 0.0), AZIMUTH)
        arc_length = (torch.arange(20, dtype=torch.float64) + 0.5) / 20
        couple = no_couple(parameters)
        if twisting:
            couple[0] = torch.stack([3 * (3 * arc_length).sin(), 4 * (2 * arc_length).cos(), arc_length]) / 20
        return make_backend("numba", parameters).control_step(start, couple, substeps=round(0.4 / dt)).position

    curves = []
    for label, damping, twisting in (
        ("undamped, in a plane", 0.0, False),
        ("undamped, bent and twisted", 0.0, True),
        ("the arm's damping, in a plane", 0.3, False),
    ):
        exact = end(steps[-1] / 64, damping, twisting)
        errors = [(end(dt, damping, twisting) - exact).abs().max().item() for dt in steps]
        order = np.log2(np.divide(errors[:-1], errors[1:]))
        curves.append({"label": label, "error_m": errors, "order": order.tolist()})
    return {"dt_s": steps, "elements": 20, "curves": curves}


def float32() -> Result:
    """Distance between the tips of a float32 and a float64 arm under the same smooth random torque over 80 s.

    For scale: the same for two float64 arms, one of which receives its torque rounded to float32. And how far the
    float32 arm's directors are from orthonormal: the largest entry of Q Q^T - 1.
    """
    seconds, seeds, until = 80.0, range(8), (1, 10, 80)
    scenes = {
        "free": [Case(seconds, seed=seed) for seed in seeds],
        "wall": [Case(seconds, seed=seed, peak=10.0, push=(16.0, 2.0), posts=CASES["wall"].posts) for seed in seeds],
    }
    control_dt = RodParameters().control_dt
    kept = np.unique(np.geomspace(1, round(seconds / control_dt), 300).astype(int)) - 1
    result: Result = {"seeds": len(seeds), "time_s": short(control_dt * (kept + 1)), "scenes": {}}
    for scene, cases in scenes.items():
        distances, skew = against_float64(cases)
        result["scenes"][scene] = {
            name: {
                "median_m": short(np.median(distance, axis=1)[kept]),
                "largest_m": short(distance.max(axis=1)[kept]),
                "median_of_largest_until_m": {
                    f"{t} s": float(np.median(distance[: round(t / control_dt)].max(axis=0))) for t in until
                },
                "largest_until_m": {f"{t} s": float(distance[: round(t / control_dt)].max()) for t in until},
            }
            for name, distance in distances.items()
        }
        result["scenes"][scene]["float32"]["director_error_at"] = {
            f"{t} s": float(skew[round(t / control_dt) - 1]) for t in until
        }
    return result


def against_float64(cases: list[Case]) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Compare arms with their float64 doubles.

    Returns:
        Distances of tips, m, ``(steps, cases)``, of the float32 arm and of the one whose torque is rounded to float32;
        the float32 arm's largest entry of Q Q^T - 1, ``(steps,)``.
    """
    rod, couples = make_backend("numba", cases[0].parameters), [case.couple() for case in cases]
    precision = {"reference": torch.float64, "float32": torch.float32, "torque": torch.float64}
    states = {name: straight_rods(rod.parameters, len(cases), dtype) for name, dtype in precision.items()}
    cylinders = {name: _obstacles(cases, dtype) for name, dtype in precision.items()}
    distances: dict[str, list[np.ndarray]] = {"float32": [], "torque": []}
    skew = []
    for step in range(cases[0].steps):
        couple = torch.as_tensor(np.stack([couple(step) for couple in couples]))
        rounded = couple.float()
        given = {"reference": couple, "float32": rounded, "torque": rounded.double()}
        for name in precision:
            states[name] = rod.control_step(states[name], given[name], cylinders=cylinders[name])
        tip = states["reference"].position[..., -1]
        for name, series in distances.items():
            series.append((states[name].position[..., -1].double() - tip).norm(dim=-1).numpy())
        director = states["float32"].director.double()
        gram = torch.einsum("bijn,bkjn->bnik", director, director)
        skew.append((gram - torch.eye(3, dtype=torch.float64)).abs().max().item())
    return {name: np.stack(series) for name, series in distances.items()}, np.array(skew)


def _obstacles(cases: list[Case], dtype: torch.dtype) -> Cylinders | None:
    return as_cylinders([case.posts for case in cases], dtype) if cases[0].posts else None


STUDIES = {
    "cantilever": cantilever,
    "stretch": axial_stretch,
    "arc": end_couples,
    "energy": energy,
    "time_step": time_step,
    "float32": float32,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=STUDIES, default=list(STUDIES))
    parser.add_argument("--draw", action="store_true", help="draw the figures from the results that are there")
    parser.add_argument("--output", type=Path, default=Path("benchmarks/results/validation.json"))
    parser.add_argument("--figures", type=Path, default=Path("docs"))
    options = parser.parse_args()
    torch.set_num_threads(1)

    known = json.loads(options.output.read_text())["studies"] if options.output.exists() else {}
    for name in options.only:
        if not options.draw:
            known[name] = STUDIES[name]()
        figure = options.figures / f"validation_{name}.png"
        validation_figures.draw(name, known[name], figure)
        print(f"{name}: {figure}", flush=True)
    if options.draw:
        return
    record.write(options.output, {"studies": {name: known[name] for name in STUDIES if name in known}})


if __name__ == "__main__":
    main()
