import numpy as np
import pytest
from arms import bending_arm

from softgm_bench.render.grid import make_grid
from softgm_bench.render.scene import Parts, Stage, round_cone
from softgm_bench.render.shading import CYLINDER, OCCLUSION_REACH, lit_part, open_part, smooth, texture_at

PALE = np.array([0.5, 0.5, 0.5])


def drawing_of(*blockers):
    """A drawing with nothing but blockers: (start, end, radius, owner)."""
    stage = Stage(bending_arm())
    parts = Parts()
    parts.add(round_cone(np.zeros(3), 0.1, np.zeros(3), 0.1), parts.paint(PALE))
    for start, end, radius, owner in blockers:
        parts.block(round_cone(start, radius, end, radius), owner)
    return parts.drawing(stage.light, stage.floor, stage.base_length)


def test_a_sphere_darkens_the_point_behind_it_alone():
    drawing = drawing_of(((0, 0, 0), (0, 0, 0), 0.1, 2))
    light = drawing.light[2]
    across = drawing.light[0]
    assert lit_part(drawing, *(-0.3 * light)) == 0.0
    assert lit_part(drawing, *(0.3 * light)) == 1.0
    assert lit_part(drawing, *(-0.3 * light + 0.3 * across)) == 1.0


def test_the_penumbra_is_a_smooth_way_from_dark_to_light():
    drawing = drawing_of(((0, 0, 0), (0, 0, 0), 0.1, 2))
    ways = np.linspace(0.0, 0.2, 41)[:, None]
    lit = np.array([lit_part(drawing, *p) for p in -0.5 * drawing.light[2] + ways * drawing.light[0]])
    assert (np.diff(lit) >= 0.0).all()
    assert np.diff(lit).max() < 0.2
    assert lit[ways[:, 0].searchsorted(0.1)] == pytest.approx(0.5, abs=0.05)


def test_no_light_comes_through_the_seam_of_two_cylinders():
    u, v, light = drawing_of(((0, 0, 0), (0, 0, 0), 0.1, 2)).light
    pair = [(side * 0.1 * u - 0.5 * v, side * 0.1 * u + 0.5 * v, 0.1, CYLINDER) for side in (-1, 1)]
    drawing = drawing_of(*pair)
    seam = [lit_part(drawing, *(-0.4 * light + x * u)) for x in np.linspace(-0.1, 0.1, 21)]
    assert max(seam) < 1e-9


def test_ambient_light_is_taken_by_what_is_near_and_in_front():
    drawing = drawing_of(((0, 0, 0), (0, 0, 0), 0.1, 2))
    below = [open_part(drawing, 0.0, 0.0, -d, 0.0, 0.0, 1.0) for d in (0.12, 0.2, 0.29)]
    assert below == sorted(below)
    assert below[0] < 0.7 < below[-1] < 1.0
    assert open_part(drawing, 0.0, 0.0, -0.12, 0.0, 0.0, -1.0) == 1.0
    assert open_part(drawing, 0.0, 0.0, -0.2 - OCCLUSION_REACH, 0.0, 0.0, 1.0) == 1.0


def test_a_texture_is_linear_between_texels_and_constant_beyond_the_ends():
    drawing = drawing_of(((0, 0, 0), (0, 0, 0), 0.1, 2))
    width = drawing.texture.shape[1]
    drawing.texture[0, :, 0] = np.arange(width)
    assert texture_at(drawing, 0, 10.5 / width)[0] == pytest.approx(10.0)
    assert texture_at(drawing, 0, 11.25 / width)[0] == pytest.approx(10.75)
    assert texture_at(drawing, 0, 0.0)[0] == 0.0
    assert texture_at(drawing, 0, 1.0)[0] == pytest.approx(width - 1, abs=1e-3)


def test_the_smooth_step_has_its_ends_and_its_middle():
    assert [smooth(x) for x in (-1.0, 0.0, 0.5, 1.0, 2.0)] == [0.0, 0.0, 0.5, 1.0, 1.0]


def test_shadows_are_found_wherever_the_grid_is_cut():
    """Every blocker is looked at, or the cell's list holds every blocker that takes light there."""
    rng = np.random.default_rng(3)
    blockers = [(*rng.uniform(-0.5, 0.5, (2, 3)), 0.05, 2) for _ in range(12)]
    drawing = drawing_of(*blockers)
    everything = make_grid(np.full((12, 3), -9.0), np.full((12, 3), 9.0), 18.0)
    whole = drawing._replace(shadow_grid=everything, near_grid=everything)
    for place in rng.uniform(-0.6, 0.6, (300, 3)):
        assert lit_part(drawing, *place) == lit_part(whole, *place)
        assert open_part(drawing, *place, 0.0, 0.6, 0.8) == open_part(whole, *place, 0.0, 0.6, 0.8)
