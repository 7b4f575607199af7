"""Heights of the surface model: wrong layers are left out, small holes are filled, others not."""

from __future__ import annotations

import numpy as np

from pipeline.io.geotiff import NODATA
from pipeline.survey.grid import grid_over
from pipeline.survey.heights import FILL_CELLS, cell_heights, filled, on_surface, smoothed


def ground(step=0.25, size=6.0):
    x, y = np.meshgrid(np.arange(0, size, step) + 0.01, np.arange(0, size, step) + 0.01)
    return np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])


def test_a_roof_hides_the_ground_and_a_few_wrong_points_do_not():
    points = ground()
    roof = points[points[:, 0] > 3] + np.array([0, 0, 5.0])
    wrong = points[::37] + np.array([0, 0, 2.5])
    every = np.concatenate([points, roof, wrong])
    grid = grid_over(every, 0.5)
    chosen = every[on_surface(every, grid, gap=1.0)]
    assert set(np.unique(chosen[:, 2])) == {0.0, 5.0}
    found = cell_heights(chosen, grid)
    column = found.cells % grid.width
    assert (found.heights[column > 6] == 5).all() and (found.heights[column < 6] == 0).all()


def test_small_holes_are_filled_and_the_outside_is_not():
    heights = np.full((60, 60), NODATA, np.float32)
    heights[10:50, 10:50] = 7
    heights[20:24, 20:24] = NODATA
    wide = slice(28, 28 + 3 * FILL_CELLS)
    heights[wide, wide] = NODATA
    found = smoothed(filled(heights))
    assert (found[20:24, 20:24] == 7).all()
    assert (found[:10] == NODATA).all() and (found[:, 50:] == NODATA).all()
    assert found[40, 40] == NODATA


def test_a_median_keeps_edges_and_removes_spikes():
    heights = np.zeros((20, 20), np.float32)
    heights[:, 10:] = 4
    heights[5, 5] = 9
    found = smoothed(heights)
    assert (found[:, :10] == 0).all() and (found[:, 10:] == 4).all()


def test_strips_are_the_rows_of_the_whole():
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(0, 30, (9000, 2)) * [1, 20], rng.normal(size=9000)])
    found = cell_heights(points, grid_over(points, 1.0))
    assert found.grid.height > 512
    whole = np.full(found.grid.height * found.grid.width, NODATA, np.float32)
    whole[found.cells] = found.heights
    expected = smoothed(filled(whole.reshape(found.grid.height, -1)))
    np.testing.assert_array_equal(np.concatenate(list(found.strips())), expected)
