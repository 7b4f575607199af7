"""The preset ``original`` has the values of 3DGS as published.

Sources: Kerbl et al. 2023, "3D Gaussian Splatting for Real-Time Radiance Field Rendering", sections
5 and 7.1 and appendix B; ``OptimizationParams`` and ``GaussianModel`` of the authors' code of 2023
(https://github.com/graphdeco-inria/gaussian-splatting), whose names the table has.
"""

import pytest

from pipeline.config.density import Original
from pipeline.config.load import scene_config
from pipeline.training.density import original
from pipeline.training.density.growth import SPLIT_SHRINK

CONFIG = scene_config({"preset": "original"}, "scene")
RATES = CONFIG.experiments.train

PUBLISHED = {
    "iterations": (CONFIG.train.steps, 30_000),
    "resolution: longest side, pixels": (CONFIG.views.max_long_side_px, 1600),
    "llffhold": (CONFIG.split.test_every, 8),
    "sh_degree": (CONFIG.train.sh_degree, 3),
    "oneupSHdegree, iterations": (RATES.sh_degree_interval, 1000),
    "lambda_dssim": (CONFIG.train.ssim_loss_weight, 0.2),
    "position_lr_init": (RATES.means_learning_rate, 0.00016),
    "position_lr_final": (RATES.means_final_learning_rate, 0.0000016),
    "spatial_lr_scale": (RATES.means_learning_rate_unit, "camera_extent"),
    "feature_lr": (RATES.sh0_learning_rate, 0.0025),
    "feature_lr / 20": (RATES.shN_learning_rate, 0.0025 / 20),
    "opacity_lr": (RATES.opacities_learning_rate, 0.05),
    "scaling_lr": (RATES.scales_learning_rate, 0.005),
    "rotation_lr": (RATES.quats_learning_rate, 0.001),
    "Adam's first beta": (RATES.adam_beta1, 0.9),
    "Adam's epsilon": (RATES.adam_epsilon, 0.0),
    "initial opacity": (CONFIG.experiments.init.opacity, 0.1),
    "densify_from_iter": (original.FROM_STEP, 500),
    "densify_until_iter": (original.UNTIL_STEP, 15_000),
    "densification_interval": (original.INTERVAL, 100),
    "densify_grad_threshold": (original.GRADIENT_THRESHOLD, 0.0002),
    "percent_dense": (original.PERCENT_DENSE, 0.01),
    "opacity_reset_interval": (original.RESET_INTERVAL, 3000),
    "min_opacity": (original.MIN_OPACITY, 0.005),
    "pruned scale, extents": (original.MAX_SCALE, 0.1),
    "split: factor of the scales": (SPLIT_SHRINK, 0.8 * 2),
}


@pytest.mark.parametrize("name", PUBLISHED)
def test_a_published_value(name):
    found, published = PUBLISHED[name]
    assert found == pytest.approx(published) if isinstance(published, float) else found == published


def test_nothing_is_added_to_the_published_method():
    """No coarse phase (the authors' code has none), no other losses, no changed learning rates."""
    train, experiments = CONFIG.train, CONFIG.experiments.train
    assert isinstance(train.density, Original)
    assert not (train.antialias or train.refine_poses or train.refine_intrinsics)
    assert train.appearance == "none"
    losses = (
        train.depth_loss_weight,
        experiments.mask_loss_weight,
        experiments.alpha_loss_weight,
        experiments.squared_error_loss_weight,
    )
    assert losses == (0, 0, 0, 0)
    assert experiments.coarse_share == 0
    assert experiments.learning_rate_factor == experiments.learning_rate_final_factor == 1
    assert experiments.clamp_color_gradient
