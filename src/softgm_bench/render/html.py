"""One episode as one interactive HTML file that needs no network; the same input gives the same bytes.

The page in ``viewer/`` draws with three.js, or simply on a 2D canvas where WebGL 2 is missing. Its scripts are joined
in the order of ``SCRIPTS`` and put into the page together with the style and the episode; a Content-Security-Policy
admits that one script and that one style by their hashes and nothing else.
"""

import base64
import hashlib
import json
import math
import re
import zlib
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from softgm_bench.episodes.trajectory import PATH, Trajectory
from softgm_bench.render import style
from softgm_bench.render.camera import FIELD_OF_VIEW, direction
from softgm_bench.render.scene import Stage, cylinder_of
from softgm_bench.storage.files import write_where_asked

VIEWER = Path(__file__).with_name("viewer")
PARTS = "three/three.min episode colours view arm edges scene plots matrix main"
SCRIPTS = [f"{name}.js" for name in PARTS.split()]
COLOURS = {
    name.lower(): value for name, value in vars(style).items() if name.isupper() and isinstance(value, str | tuple)
}
CYLINDER = ("start", "axis", "length", "radius")
ATTENTION_BYTES = 1_500_000  # of both stages together; a longer episode keeps the weights of every k-th step


def write_html(trajectory: Trajectory, path: Path, **view: float | None) -> None:
    """Write an episode as a page that opens in any browser, also from disk.

    Args:
        trajectory: the episode.
        path: of the file.
        view: ``azimuth`` and ``elevation`` of the first view, degrees; by default a still's.

    Raises:
        UserError: the file cannot be written.
    """
    write_where_asked(path, render_page(trajectory, **view).encode())


def render_page(trajectory: Trajectory, **view: float | None) -> str:
    """The text that ``write_html`` writes; arguments as there."""
    azimuth, elevation = direction(trajectory, **view)
    camera = {"azimuth": round(azimuth, 3), "elevation": elevation, "fov": FIELD_OF_VIEW}
    info = trajectory.info
    learnt = f"policy after {info['frames']:,} frames, " if info.get("frames") else ""
    sheet = _part("style.css")
    script = '"use strict";\n(() => {\n' + "".join(map(_part, SCRIPTS)) + "})();\n"
    parts = {
        "title": escape(f"{trajectory.config['task']['name']} · {info['label']}"),
        "caption": escape(f"{learnt}seed {info.get('seed', '?')}, episode {info.get('episode', '?')}"),
        "style": sheet,
        "script": script,
        "style_hash": _source_hash(sheet),
        "script_hash": _source_hash(script),
        "episode": _json(payload(trajectory) | {"camera": camera}),
    }
    # one pass, so that braces in what is put in are left alone
    return re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match[1]], _part("page.html"))


def payload(trajectory: Trajectory) -> dict[str, Any]:
    """The episode as the page's script reads it: plain values, and arrays as ``_array`` packs them.

    Positions are rounded to 1/65535 of the largest extent over the episode along any axis (0.03 mm for 2 m), radii to
    1/255 of their range, d1's components to 1/127, attention weights to 1/255.
    """
    task, rod = trajectory.config["task"], trajectory.config["rod"]
    slots, stage = _slots(trajectory), Stage(trajectory)
    extent, cylinders = stage.extent(), trajectory.cylinders
    packed = {
        "position": _rounded(trajectory.position.transpose(0, 2, 1), np.uint16),
        "normal": _array(np.rint(127.0 * trajectory.director[:, 0].transpose(0, 2, 1)), np.int8, scale=1.0 / 127.0),
        "radius": _rounded(trajectory.radius(), np.uint8),
        "contact": _bits(trajectory.contact),
        "action": _rounded(trajectory.action, np.uint16),
        "reward": _array(trajectory.reward, np.float32),
        "terms": _array(np.stack(list(trajectory.reward_terms.values())), np.float32),
        "edge": _bits(trajectory.observation["agents/edge"][..., : len(slots)]),
    }
    if PATH in cylinders:  # how far each is from where it began
        packed["shift"] = _rounded(cylinders[PATH] - cylinders["start"], np.uint16)
    if np.any(trajectory.tip_force):
        packed["force"] = _array(trajectory.tip_force, np.float32)
    return {
        "task": task["name"],
        "label": str(trajectory.info["label"]),
        "steps": trajectory.steps,
        "controlDt": rod["dt"] * rod["substeps"],
        "agentNodes": [int(node) for node in trajectory.agent_nodes],
        "nodes": int(trajectory.position.shape[2]),
        "baseLength": rod["base_length"],
        "baseRadius": trajectory.arm.base_radius,
        "successRadius": task["success_radius"],
        "success": bool(trajectory.success),
        "diverged": bool(trajectory.diverged),
        "target": _numbers(trajectory.target),
        "cylinders": [_numbers(row) for row in np.column_stack([cylinders[name] for name in CYLINDER])],
        "wall": stage.wall,
        "floor": round(float(extent[:, 2].min()), 6),
        "extent": [_numbers(extent[corner]) for corner in ConvexHull(extent).vertices],
        "slots": slots,
        "terms": list(trajectory.reward_terms),
        "colours": COLOURS,
        "arrays": packed,
        "attention": _attention(trajectory.attention),
    }


def _numbers(values: NDArray) -> list[float]:
    return [round(float(value), 6) for value in values]


def _slots(trajectory: Trajectory) -> list[dict[str, Any]]:
    """Discovered bins in the order of their slots: step of discovery, centre, axis, radius and half length, m.

    Of a bin that moves: its cylinder too, and the centre where both began.
    """
    active = trajectory.observation["slots/active"]
    used = int(active[-1].sum())  # slots are filled from the front and never emptied
    half_bin = 0.5 * trajectory.config["task"]["bin_length"]
    slots = []
    for slot, row in enumerate(trajectory.observation["slots/descriptor"][-1, :used]):
        radius, length, middle = _numbers(row[6:])
        half = round(min(half_bin, length * (1.0 - middle)), 6)  # a cylinder's last bin may be shorter
        place = {"centre": _numbers(row[:3]), "axis": _numbers(row[3:6]), "radius": radius, "half": half}
        first = int(active[:, slot].argmax())
        if PATH in trajectory.cylinders:
            c, along = cylinder_of(trajectory, slot, first)
            began = trajectory.cylinders["start"][c] + along * trajectory.cylinders["axis"][c]
            place |= {"cylinder": c, "centre": _numbers(began)}
        slots.append({"step": first} | place)
    return slots


def _array(values: NDArray, dtype: type, *, scale: float = 1.0, offset: float = 0.0) -> dict[str, Any]:
    """Little-endian bytes, compressed and in base64; a value is ``offset + scale * stored``."""
    stored = np.ascontiguousarray(values).astype(np.dtype(dtype).newbyteorder("<"))
    return {
        "type": np.dtype(dtype).name,
        "shape": list(stored.shape),
        "scale": scale,
        "offset": offset,
        "data": base64.b64encode(zlib.compress(stored.tobytes(), 9)).decode(),
    }


def _rounded(values: NDArray, dtype: type) -> dict[str, Any]:
    """Values rounded to equal steps between their smallest and their largest.

    Raises:
        ValueError: a value is not finite.
    """
    if not np.isfinite(values).all():
        raise ValueError("the trajectory holds numbers that are not finite")
    low, high = (float(values.min()), float(values.max())) if values.size else (0.0, 0.0)
    scale = (high - low) / np.iinfo(dtype).max or 1.0
    return _array(np.rint((values.astype(np.float64) - low) / scale), dtype, scale=scale, offset=low)


def _bits(values: NDArray) -> dict[str, Any]:
    """One row of bits per step, the first value in the lowest bit of the first byte."""
    return _array(np.packbits(values.reshape(len(values), -1), axis=1, bitorder="little"), np.uint8)


def _attention(attention: dict[str, NDArray]) -> dict[str, Any]:
    """Weights of every stage, those that round to 0 left out; rows of step k are ``begin[k]`` to ``begin[k + 1]``."""
    rounded = {stage: np.rint(255.0 * weights).astype(np.uint8) for stage, weights in attention.items()}
    edges = {stage: np.asarray(weights.any(axis=(1, 2))) for stage, weights in rounded.items()}  # (T, N, sources)
    size = sum(int(edges[stage].sum()) * (4 + math.prod(weights.shape[1:3])) for stage, weights in rounded.items())
    every = max(1, math.ceil(size / ATTENTION_BYTES))
    stages = {}
    for stage, weights in rounded.items():
        step, receiver, source = edges[stage][::every].nonzero()
        count = np.bincount(step, minlength=len(weights[::every]))
        stages[stage] = {
            "layers": weights.shape[1],
            "heads": weights.shape[2],
            "every": every,
            "begin": _array(np.concatenate([[0], np.cumsum(count)]), np.uint32),
            "receiver": _array(receiver, np.uint16),
            "source": _array(source, np.uint16),
            "weight": _array(weights[::every][step, :, :, receiver, source], np.uint8, scale=1.0 / 255.0),
        }
    return stages


def _part(name: str) -> str:
    return (VIEWER / name).read_text(encoding="utf-8")


def _source_hash(text: str) -> str:
    """As Content-Security-Policy writes it."""
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


def _json(value: Any) -> str:
    """JSON that no HTML parser takes for markup."""
    text = json.dumps(value, allow_nan=False, separators=(",", ":"))
    return text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")
