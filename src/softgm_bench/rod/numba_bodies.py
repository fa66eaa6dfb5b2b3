"""The Numba kernel's rod becomes another body: the nominal constants in its buffer times a few numbers."""

from collections.abc import Callable
from typing import Any

from softgm_bench.rod.bodies import Scales
from softgm_bench.rod.numba_kernel import jit
from softgm_bench.rod.numba_layout import Layout

SHEAR, BEND, MASS, INERTIA, VOLUME, TRANSLATIONAL, ROTATIONAL, FRICTION = range(len(Scales._fields))


def make_shape(layout: Layout, real: type) -> Callable[..., Any]:
    """Compile ``shape``, which turns the constants of the nominal rod into those of one environment's body."""
    p, n, nodes = layout, layout.elements, layout.nodes
    one = real(1.0)

    def shape(s, scales):
        """Change a buffer that holds the nominal constants; ``scales`` are in the order of ``Scales``."""
        over_inertia, over_mass = one / scales[INERTIA], one / scales[MASS]
        for k in range(n):
            s[p.shear0 + k] *= scales[SHEAR]
            s[p.shear2 + k] *= scales[SHEAR]
            s[p.bend0 + k] *= scales[BEND]
            s[p.bend2 + k] *= scales[BEND]
            s[p.inertia0 + k] *= scales[INERTIA]
            s[p.inertia2 + k] *= scales[INERTIA]
            s[p.step0 + k] *= over_inertia
            s[p.step2 + k] *= over_inertia
            s[p.decay_rate + k] *= scales[ROTATIONAL]
        for k in range(n):
            s[p.decay0 + k] = s[p.decay0 + k] ** scales[ROTATIONAL]
            s[p.decay2 + k] = s[p.decay2 + k] ** scales[ROTATIONAL]
        for k in range(nodes):
            s[p.node_step + k] *= over_mass

    return jit(shape)
