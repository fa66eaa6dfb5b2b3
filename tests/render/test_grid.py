import numpy as np

from softgm_bench.render.grid import cell_of, make_grid


def test_a_cell_lists_exactly_the_boxes_that_meet_it():
    rng = np.random.default_rng(0)
    low = rng.uniform(-1.0, 1.0, (40, 3))
    high = low + rng.uniform(0.0, 0.8, (40, 3))
    grid = make_grid(low, high, 0.3)
    for k, j, i in np.ndindex(*grid.shape[::-1]):
        corner = grid.origin + 0.3 * np.array([i, j, k])
        meets = np.all((low < corner + 0.3) & (high >= corner), axis=1)
        cell = (k * grid.shape[1] + j) * grid.shape[0] + i
        np.testing.assert_array_equal(grid.items[grid.first[cell] : grid.first[cell + 1]], np.flatnonzero(meets))
        assert cell_of(grid, *(corner + 0.15)) == cell
    assert cell_of(grid, *(grid.origin - 0.01)) == -1
    assert cell_of(grid, *(grid.origin + 0.3 * grid.shape + 0.01)) == -1


def test_boxes_are_cut_at_the_bounds():
    low, high = np.array([[-5.0, 0.0, 0.0], [9.0, 0.0, 0.0]]), np.array([[0.5, 0.0, 0.0], [9.5, 0.0, 0.0]])
    grid = make_grid(low, high, 1.0, ([0.0, 0.0, 0.0], [3.0, 0.0, 0.0]))
    assert grid.shape.tolist() == [4, 1, 1]
    assert grid.items.tolist() == [0]
    assert grid.first.tolist() == [0, 1, 1, 1, 1]


def test_cells_grow_rather_than_fill_the_memory():
    grid = make_grid(np.zeros((1, 3)), np.full((1, 3), 1e3), 1e-3)
    assert len(grid.first) <= 1_000_001
