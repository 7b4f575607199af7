"""A lens that no model holds exactly is fitted; the largest error over the image is returned."""

import numpy as np

from pipeline.geometry.distortion import project
from pipeline.geometry.lens_fit import MAX_RESIDUAL_PX, fit_camera
from pipeline.io.poses.lenses import Brown

START = (3600.0, 3600.0, 2736.0, 1824.0, -0.05, 0.02, 0.0, 0.0, 0.01, 0.0, 0.0, 0.0)


def brown(**changes) -> Brown:
    fields = {"k": (-0.05, 0.02, 0.01, -0.008), "p": (1e-3, -5e-4), **changes}
    return Brown(3600.0, 3600.0, 2736.0, 1824.0, **fields)


def test_a_fourth_radial_coefficient_is_fitted():
    lens = brown()
    camera, residual = fit_camera("FULL_OPENCV", 5472, 3648, START, lens.project)
    assert residual < MAX_RESIDUAL_PX
    rays = np.random.default_rng(0).uniform(-0.45, 0.45, (500, 2))
    error = np.linalg.norm(project(camera, rays) - lens.project(rays), axis=1)
    assert error.max() < MAX_RESIDUAL_PX


def test_the_residual_of_a_skew_is_told():
    _, residual = fit_camera("FULL_OPENCV", 5472, 3648, START, brown(skew=40.0).project)
    assert 1 < residual < 40


def test_a_lens_that_folds_inside_the_image_has_no_camera():
    lens = brown(k=(-2.0, 0.0, 0.0, 0.0))
    start = (*START[:4], -2.0, *[0.0] * 7)
    _, residual = fit_camera("FULL_OPENCV", 5472, 3648, start, lens.project)
    assert np.isinf(residual)
