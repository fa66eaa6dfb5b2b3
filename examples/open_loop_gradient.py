"""Reach targets of task ``basic`` with open-loop torques found by gradient descent through the simulator.

The PyTorch backend differentiates the tip's final distance with respect to every agent's action at every control step,
through thousands of substeps of the paper's arm. The result is replayed by the Numba backend, which shares no code of
the motion with it, and one derivative is compared with a finite difference. Writes the numbers as JSON and draws them::

    python examples/open_loop_gradient.py --json examples/open_loop_gradient.json --picture docs/open_loop_gradient.png
"""

import argparse
import json
import time
from pathlib import Path

import torch
from torch import Tensor

from softgm_bench.config import Config, compose
from softgm_bench.envs.tasks import make_task
from softgm_bench.rod.actuation import Actuation
from softgm_bench.rod.backend import Backend
from softgm_bench.rod.numba_backend import NumbaBackend
from softgm_bench.rod.state import straight_rods
from softgm_bench.rod.torch_backend import TorchBackend

RELAXATION = 0.7  # of Polyak's step: a whole one zigzags
SHAPES = 6  # of the arm in each drawing, equally spaced in time
LONGEST_STEP = 0.3  # root mean square change of the actions before their tanh


def build_actuation(config: Config) -> Actuation:
    """The task's own agents and torques."""
    task = config.task
    settings = task.actuation
    return Actuation(config.rod, task.n_agents, settings.max_torque, settings.basis, settings.scaling)


def rollout(backend: Backend, actuation: Actuation, actions: Tensor) -> Tensor:
    """Node positions after every control step, the rest shape first: ``(control_steps + 1, n_targets, 3, n_nodes)``.

    ``actions`` are ``(control_steps, n_targets, n_agents, 2)`` in [-1, 1].
    """
    state = straight_rods(backend.parameters, actions.shape[1])
    positions = [state.position]
    for action in actions:
        state = backend.control_step(state, actuation.couple(action))
        positions.append(state.position)
    return torch.stack(positions)


def tip_distance(positions: Tensor, target: Tensor) -> Tensor:
    """Distance of the tips to their targets, m: ``(..., n_targets)``."""
    return (positions[..., -1] - target).norm(dim=-1)


def optimise(
    backend: TorchBackend, actuation: Actuation, target: Tensor, control_steps: int, iterations: int
) -> tuple[Tensor, list[dict[str, list[float]]]]:
    """Gradient descent on actions before their tanh, from rest, with Polyak's step length for each target.

    That length, ``distance / |gradient|^2``, would reach the target at once if the distance were linear. RELAXATION
    takes part of it and LONGEST_STEP bounds its root mean square: there is nothing to tune to the arm.

    Returns:
        The best actions of each target, ``(control_steps, n_targets, n_agents, 2)``, and each iteration's final
        distance, m, and norm of its gradient.
    """
    raw = torch.zeros(control_steps, len(target), actuation.matrix.shape[0], 2, dtype=torch.float64, requires_grad=True)
    best_actions, best = torch.zeros_like(raw), torch.full((len(target),), torch.inf, dtype=torch.float64)
    history = []
    for iteration in range(iterations):
        actions = raw.tanh()
        distance = tip_distance(rollout(backend, actuation, actions)[-1], target)
        (gradient,) = torch.autograd.grad(distance.sum(), raw)
        norm = torch.linalg.vector_norm(gradient, dim=(0, 2, 3))
        with torch.no_grad():
            best_actions = torch.where((distance < best)[:, None, None], actions, best_actions)
            best = torch.minimum(distance, best)
            step = RELAXATION * (distance / norm**2)[:, None, None] * gradient
            size = step.square().mean(dim=(0, 2, 3), keepdim=True).sqrt()
            raw -= step * (LONGEST_STEP / size).clamp(max=1.0)
        history.append({"distance": distance.tolist(), "gradient_norm": norm.tolist()})
        print(f"{iteration:3d}  tip distance {', '.join(f'{100.0 * d:7.3f}' for d in distance)} cm", flush=True)
    return best_actions, history


def check_derivative(backend: TorchBackend, actuation: Actuation, target: Tensor, actions: Tensor) -> dict[str, float]:
    """One derivative through the whole sequence against a central difference of the Numba backend.

    It is the derivative of the squared final distance with respect to the first control step's action, whose effect
    passes through every later substep.
    """
    numba = NumbaBackend(backend.parameters)
    where, step = (0, 0, 0, 0), 1e-4
    # half-way, where the gradient is not the zero of an optimum
    point = (0.5 * actions).requires_grad_()
    loss = tip_distance(rollout(backend, actuation, point)[-1], target).square().sum()
    (gradient,) = torch.autograd.grad(loss, point)
    values = []
    for sign in (1.0, -1.0):
        moved = point.detach().clone()
        moved[where] += sign * step
        values.append(tip_distance(rollout(numba, actuation, moved)[-1], target).square().sum().item())
    return {"gradient": gradient[where].item(), "finite_difference": (values[0] - values[1]) / (2.0 * step)}


def gradient_against_horizon(backend: TorchBackend, actuation: Actuation, actions: Tensor) -> list[dict[str, float]]:
    """Norm of the first action's gradient of the final tip position's x, for sequences cut after some control steps."""
    rows = []
    for control_steps in sorted({min(count, len(actions)) for count in (2, 5, 10, 20, len(actions))}):
        point = actions[:control_steps].clone().requires_grad_()
        tip = rollout(backend, actuation, point)[-1, :, :, -1]
        (gradient,) = torch.autograd.grad(tip[:, 0].sum(), point)
        rows.append({"control_steps": control_steps, "norm_of_first": gradient[0].norm().item()})
    return rows


def rounded(positions: Tensor) -> list:
    """Nested lists of metres to a hundredth of a millimetre, for drawing."""
    return (positions * 1e5).round().div(1e5).tolist()


def draw(result: dict, picture: Path) -> None:
    """The final distance against iterations, and each arm on its way to its target."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure = plt.figure(figsize=(10.0, 5.2))
    axes = figure.add_axes((0.075, 0.12, 0.37, 0.78))
    count = len(result["targets"])
    for i in range(count):
        distances = [100.0 * row["distance"][i] for row in result["history"]]
        axes.semilogy(distances, color=f"C{i}", label=f"target {i + 1}")
    axes.axhline(100.0 * result["success_radius"], color="0.5", linewidth=0.8, linestyle="--", label="success radius")
    axes.set(xlabel="iteration of gradient descent", ylabel="distance of tip and target at the end, cm")
    axes.legend(frameon=False, fontsize=8)
    axes.spines[["top", "right"]].set_visible(False)
    columns = -(-count // 2)
    for i in range(count):
        width = 0.53 / columns
        place = (0.46 + width * (i % columns), 0.45 * (1 - i // columns), width, 0.47)
        draw_arm(figure.add_axes(place, projection="3d"), result, i)
    times = result["control_dt"] * torch.linspace(0, len(result["actions"]), SHAPES).round()
    figure.text(0.73, 0.955, "arms at " + ", ".join(f"{t:g}" for t in times.tolist()) + " s", ha="center", fontsize=9)
    picture.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(picture, dpi=150)


def draw_arm(axes, result: dict, i: int) -> None:
    """Shapes of one arm, later ones darker, the path of its tip and its target, above a ground of 0.5 m and 1 m."""
    shapes, tips, targets = (torch.tensor(result[name]) for name in ("shapes", "tips", "targets"))
    angle = torch.linspace(0.0, 2.0 * torch.pi, 100)
    for radius in (0.5, 1.0):
        axes.plot(radius * angle.cos(), radius * angle.sin(), 0.0 * angle, color="0.8", linewidth=0.7)
    for line in ([[-1, 1], [0, 0]], [[0, 0], [-1, 1]]):
        axes.plot(*line, [0, 0], color="0.8", linewidth=0.7)
    for k, shape in enumerate(shapes[:, i]):
        share = k / (len(shapes) - 1)
        axes.plot(*shape, color=f"C{i}", alpha=0.15 + 0.85 * share, linewidth=1.5 + 2.5 * share, solid_capstyle="round")
    axes.plot(*tips[:, i].T, color="0.3", linewidth=0.9, linestyle=":")
    axes.scatter(*targets[i][:, None], color="black", marker="*", s=70, depthshade=False, zorder=10)
    axes.set(xlim=(-0.9, 0.9), ylim=(-0.9, 0.9), zlim=(-0.05, 1.0))
    axes.set_box_aspect((1.8, 1.8, 1.05), zoom=1.2)
    azimuth = torch.rad2deg(torch.atan2(targets[i, 1], targets[i, 0]))
    axes.view_init(elev=16, azim=azimuth.item() - 80.0)
    axes.set_axis_off()
    axes.set_title(f"target {i + 1}: {100.0 * result['numba_distance'][i]:.2f} cm", fontsize=9, y=0.9)


def main() -> None:
    """Optimise, replay, check, write and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--targets", type=int, default=4)
    parser.add_argument("--control-steps", type=int, default=20)
    parser.add_argument("--iterations", type=int, default=25)
    parser.add_argument("--seed", type=int, default=0, help="of the targets")
    parser.add_argument("--json", type=Path, default=Path("open_loop_gradient.json"))
    parser.add_argument("--picture", type=Path, default=Path("open_loop_gradient.png"))
    options = parser.parse_args()
    torch.set_num_threads(1)

    config = compose(["task=basic"])
    actuation = build_actuation(config)
    target = make_task(config.task).sample(options.targets, torch.Generator().manual_seed(options.seed)).target
    backend = TorchBackend(config.rod, checkpoint_every=50)
    begun = time.perf_counter()
    actions, history = optimise(backend, actuation, target, options.control_steps, options.iterations)
    seconds = time.perf_counter() - begun

    with torch.no_grad():
        by_torch = tip_distance(rollout(backend, actuation, actions)[-1], target)
    positions = rollout(NumbaBackend(config.rod), actuation, actions)
    by_numba = tip_distance(positions[-1], target)
    result = {
        "options": {name: value for name, value in vars(options).items() if name not in ("json", "picture")},
        "success_radius": config.task.success_radius,
        "control_dt": config.rod.control_dt,
        "seconds": seconds,
        "torch_distance": by_torch.tolist(),
        "numba_distance": by_numba.tolist(),
        "derivative": check_derivative(backend, actuation, target, actions),
        "gradient_against_horizon": gradient_against_horizon(backend, actuation, actions),
        "targets": target.tolist(),
        "history": history,
        "actions": actions.tolist(),
        "shapes": rounded(positions[torch.linspace(0, len(actions), SHAPES).round().long()]),
        "tips": rounded(positions[..., -1]),
    }
    for name in ("seconds", "torch_distance", "numba_distance", "derivative", "gradient_against_horizon"):
        print(name, result[name])
    options.json.parent.mkdir(parents=True, exist_ok=True)
    options.json.write_text(json.dumps(result))
    draw(result, options.picture)


if __name__ == "__main__":
    main()
