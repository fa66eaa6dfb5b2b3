import numpy as np
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from softgm_bench.render.geometry import MISS, hit_round_cone, hit_sphere, nearest_on_axis, normal_at

coordinate = st.floats(-1.0, 1.0)
point = st.tuples(coordinate, coordinate, coordinate).map(np.array)
radius = st.floats(0.05, 0.6)


@st.composite
def cones(draw):
    return np.array([[*draw(point), draw(radius), *draw(point), draw(radius)]])


def distance(place, cone):
    """Signed distance to the union of all spheres between both ends, by looking at many and refining the best."""
    low, high = 0.0, 1.0
    for _ in range(4):
        y = np.linspace(low, high, 401)[:, None]
        centre, r = cone[:3] + y * (cone[4:7] - cone[:3]), cone[3] + y[:, 0] * (cone[7] - cone[3])
        values = np.linalg.norm(place - centre, axis=1) - r
        best, width = int(values.argmin()), (high - low) / 400
        low, high = max(0.0, y[best, 0] - width), min(1.0, y[best, 0] + width)
    return values.min()


def march(origin, direction, cone):
    """First point of the ray by steps as long as nothing can be hit, or None; the smallest distance met."""
    t, smallest = 0.0, np.inf
    for _ in range(500):
        d = distance(origin + t * direction, cone)
        smallest = min(smallest, d)
        if d < 1e-7:
            return t, smallest
        t += d
        if t > 20.0:
            break
    return None, smallest


@settings(max_examples=150, deadline=None)
@given(cones(), point, st.tuples(coordinate, coordinate, coordinate).map(np.array))
def test_a_ray_hits_where_sphere_marching_arrives(cone, aim, side):
    assume(np.linalg.norm(side) > 0.1)
    origin = 5.0 * side / np.linalg.norm(side)
    direction = (aim - origin) / np.linalg.norm(aim - origin)
    expected, smallest = march(origin, direction, cone[0])
    t, y = hit_round_cone(*origin, *direction, cone, 0)
    if expected is None:
        assume(smallest > 1e-5)  # grazing rays are decided by rounding
        assert t == MISS
        return
    place = origin + expected * direction
    normal = np.array(normal_at(*place, cone, 0, y))
    assume(abs(normal @ direction) > 0.02)  # a slanting hit's place along the ray is badly conditioned
    assert abs(t - expected) < 1e-5
    assert 0.0 <= y <= 1.0


@settings(max_examples=50, deadline=None)
@given(cones(), st.tuples(coordinate, coordinate, coordinate).map(np.array))
def test_normals_are_the_gradient_of_the_distance(cone, side):
    assume(np.linalg.norm(side) > 0.1)
    origin = 5.0 * side / np.linalg.norm(side)
    direction = (cone[0, :3] - origin) / np.linalg.norm(cone[0, :3] - origin)
    t, y = hit_round_cone(*origin, *direction, cone, 0)
    place = origin + t * direction
    step = 1e-5 * np.eye(3)
    gradient = [(distance(place + e, cone[0]) - distance(place - e, cone[0])) / 2e-5 for e in step]
    np.testing.assert_allclose(normal_at(*place, cone, 0, y), gradient, atol=1e-3)


def test_a_ray_along_the_axis_hits_the_near_end():
    capsule = np.array([[0.0, 0.0, 0.0, 0.1, 1.0, 0.0, 0.0, 0.1]])
    assert hit_round_cone(-3.0, 0.0, 0.0, 1.0, 0.0, 0.0, capsule, 0) == (2.9, 0.0)
    t, y = hit_round_cone(4.0, 0.0, 0.0, -1.0, 0.0, 0.0, capsule, 0)
    assert abs(t - 2.9) < 1e-12
    assert y == 1.0


def test_what_is_behind_the_origin_is_missed():
    assert hit_sphere(0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, -2.0, 1.0) == MISS
    behind = np.array([[0.0, -1.0, -2.0, 0.5, 0.0, 1.0, -2.0, 0.4]])
    assert hit_round_cone(0.0, 0.0, 0.0, 0.0, 0.0, 1.0, behind, 0)[0] == MISS


def test_the_nearest_point_of_an_axis_stays_between_its_ends():
    cone = np.array([[0.0, 0.0, 0.0, 0.1, 2.0, 0.0, 0.0, 0.1], [1.0, 1.0, 1.0, 0.1, 1.0, 1.0, 1.0, 0.1]])
    assert nearest_on_axis(0.5, 3.0, 0.0, cone, 0) == 0.25
    assert nearest_on_axis(-1.0, 3.0, 0.0, cone, 0) == 0.0
    assert nearest_on_axis(9.0, 3.0, 0.0, cone, 0) == 1.0
    assert nearest_on_axis(9.0, 3.0, 0.0, cone, 1) == 0.0
