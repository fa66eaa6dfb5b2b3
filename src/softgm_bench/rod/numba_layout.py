"""The layout says where each quantity of one rod lies in the flat scratch buffer of the Numba kernel.

All arrays of a rod share one buffer with compile-time offsets: LLVM then proves that they do not overlap and vectorises
the loops over elements without run-time checks. Everything a substep touches (about 30 kB in float64) stays in the L1
cache. Rows begin on cache lines and loops run over whole vectors: the padding behind the last element or node holds
constants of zero, so that whatever is computed there stays zero and no loop has a scalar remainder.
"""

import hashlib
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from softgm_bench.rod.parameters import RodParameters, rod_constants

Array = NDArray[np.floating]


class Layout(NamedTuple):
    """Each field is the offset of a row's first entry; a row's indices -1 and n exist and may hold padding zeros."""

    source: int  # digest of the kernel's source, so that machine code cached on disk never outlives it
    n: int  # elements
    elements: int  # n rounded up to whole vectors: what loops over elements run over
    nodes: int  # n + 1 rounded up likewise
    size: int  # entries of the whole buffer
    # state: position and velocity of nodes, director rows and angular velocity of elements
    px: int
    py: int
    pz: int
    vx: int
    vy: int
    vz: int
    q00: int
    q01: int
    q02: int
    q10: int
    q11: int
    q12: int
    q20: int
    q21: int
    q22: int
    w0: int
    w1: int
    w2: int
    # inputs of the control step
    t0: int  # external couple, material frame
    t1: int
    t2: int
    gx: int  # external force incl. gravity on nodes
    gy: int
    gz: int
    fx: int  # the same plus contact
    fy: int
    fz: int
    # constants of the rod
    rest: int  # rest lengths
    inverse_rest: int
    shear0: int
    shear2: int
    inertia0: int
    inertia2: int
    step0: int  # dt over inertia
    step2: int
    node_step: int  # dt over mass
    bend0: int  # on interior nodes
    bend2: int
    voronoi: int  # rest Voronoi lengths
    inverse_voronoi: int
    three: int  # 3 on interior nodes: the trace of an identity
    decay0: int  # angular velocity's factor at dilatation 1
    decay2: int
    decay_rate: int  # its exponent per unit of (dilatation - 1), twist
    # intermediates
    length: int
    dilatation: int
    sx: int  # internal force on element cross-sections, world frame
    sy: int
    sz: int
    m0: int  # torque on elements, material frame
    m1: int
    m2: int
    c0: int  # bend/twist couple at interior nodes
    c1: int
    c2: int
    k0: int  # curvature x couple at interior nodes
    k1: int
    k2: int
    distance2: int  # squared distance of elements to a cylinder's axis


CACHE_LINE = 64  # bytes; also the widest vector


def make_layout(n_elements: int, dtype: type) -> Layout:
    """Lay the rows out for a rod of ``n_elements`` in one precision."""
    width = CACHE_LINE // np.dtype(dtype).itemsize
    names = Layout._fields[5:]
    elements, nodes = (-(-count // width) * width for count in (n_elements, n_elements + 1))
    # Index -1 and index ``elements`` are read too. An odd number of lines keeps rows from the same cache sets.
    lines = nodes // width + 2
    stride = (lines + 1 - lines % 2) * width
    offsets = {name: row * stride + width for row, name in enumerate(names)}
    return Layout(
        source=_source_digest(), n=n_elements, elements=elements, nodes=nodes, size=stride * len(names), **offsets
    )


def constant_rows(parameters: RodParameters, layout: Layout, dtype: np.dtype) -> Array:
    """Return the buffer ``(layout.size,)`` with only the rod's constants (SI units) filled in."""
    constants = rod_constants(parameters)
    dt = parameters.dt
    rate = constants.rotational_decay_rate
    follows = constants.decay_follows_dilatation
    rows = {
        "rest": constants.rest_length,
        "inverse_rest": 1.0 / constants.rest_length,
        "shear0": constants.shear[0],
        "shear2": constants.shear[2],
        "inertia0": constants.inertia[0],
        "inertia2": constants.inertia[2],
        "step0": dt / constants.inertia[0],
        "step2": dt / constants.inertia[2],
        "node_step": dt / constants.mass,
        "bend0": constants.bend[0],
        "bend2": constants.bend[2],
        "voronoi": constants.rest_voronoi_length,
        "inverse_voronoi": 1.0 / constants.rest_voronoi_length,
        "three": np.full_like(constants.rest_voronoi_length, 3.0),
        "decay0": np.exp(-rate[0]),
        "decay2": np.exp(-rate[2]),
        # A circular cross-section has twice the inertia about its axis, so bending decays at twice this rate.
        "decay_rate": rate[2] if follows else np.zeros_like(rate[2]),
    }
    buffer = np.zeros(layout.size)
    for name, values in rows.items():
        start = getattr(layout, name)
        buffer[start : start + len(values)] = values
    return buffer.astype(dtype)


@cache
def _source_digest() -> int:
    folder = Path(__file__).parent
    digest = hashlib.sha256()
    for path in [*sorted(folder.glob("numba_*.py")), folder / "scalar_contact.py", folder / "bodies.py"]:
        digest.update(path.read_bytes())
    return int.from_bytes(digest.digest()[:7], "big")
