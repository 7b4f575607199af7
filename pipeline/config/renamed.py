"""Options that were renamed or moved: a configuration with an old name gets an error that says the
new one. The reference pages list them."""

from __future__ import annotations

#: Old dotted path -> new one, or several if density strategies have an option of their own each.
RENAMED: dict[str, tuple[str, ...]] = {
    "split.holdout_every": ("split.test_every",),
    "matches.max_ratio": ("experiments.matches.max_ratio",),
    "matches.min_inliers": ("experiments.matches.min_inliers",),
    "init.num_random": ("experiments.init.num_random",),
    "init.opacity": ("experiments.init.opacity",),
    "train.sh_interval": ("experiments.train.sh_degree_interval",),
    "train.memory_mb": ("partition.memory_mb",),
    "train.ssim_weight": ("train.ssim_loss_weight",),
    "train.square_weight": ("experiments.train.squared_error_loss_weight",),
    "train.coarse_until": ("experiments.train.coarse_share",),
    "train.alpha_weight": ("experiments.train.alpha_loss_weight",),
    "train.depth_weight": ("train.depth_loss_weight",),
    "train.masked_opacity": ("train.mask_loss_weight",),
    "train.pose_reach": ("experiments.train.max_pose_change",),
    "train.intrinsics_reach": ("experiments.train.max_intrinsics_change",),
    "train.salt_and_pepper": ("experiments.train.salt_and_pepper_share",),
    "train.exposure": ("train.appearance",),
    "train.black_stays": ("experiments.train.clamp_color_gradient",),
    "train.gradients_per_pixel": ("experiments.train.gradients_per_pixel",),
    "train.isotropic": ("experiments.train.isotropic",),
    "train.adam_beta1": ("experiments.train.adam_beta1",),
    "train.lr_means_unit": ("experiments.train.means_learning_rate_unit",),
    "train.lr_means": ("experiments.train.means_learning_rate",),
    "train.lr_means_final": ("experiments.train.means_final_learning_rate",),
    "train.lr_boost": ("experiments.train.learning_rate_factor",),
    "train.lr_decay_from": ("experiments.train.learning_rate_decay_start",),
    "train.lr_final_share": ("experiments.train.learning_rate_final_factor",),
    "train.lr_scales": ("experiments.train.scales_learning_rate",),
    "train.lr_quats": ("experiments.train.quats_learning_rate",),
    "train.lr_opacities": ("experiments.train.opacities_learning_rate",),
    "train.lr_sh0": ("experiments.train.sh0_learning_rate",),
    "train.lr_shN": ("experiments.train.shN_learning_rate",),
    "train.density.start_step": (
        "experiments.train.gradient.start_step",
        "experiments.train.mcmc.start_step",
    ),
    "train.density.stop_share": (
        "experiments.train.gradient.stop_share",
        "experiments.train.mcmc.stop_share",
    ),
    "train.density.interval": (
        "experiments.train.gradient.interval",
        "experiments.train.mcmc.interval",
    ),
    "train.density.grad_threshold": ("experiments.train.gradient.grad_threshold",),
    "train.density.absolute_gradient": ("experiments.train.gradient.absolute_gradient",),
    "train.density.clone": ("experiments.train.gradient.clone",),
    "train.density.split": ("experiments.train.gradient.split",),
    "train.density.split_kind": ("experiments.train.gradient.split_kind",),
    "train.density.split_scale": ("experiments.train.gradient.split_scale",),
    "train.density.clear_air": ("train.density.remove_floaters",),
    "train.density.recycle": ("experiments.train.gradient.recycle_share",),
    "train.density.prune_opacity": (
        "experiments.train.gradient.prune_opacity",
        "experiments.train.mcmc.prune_opacity",
    ),
    "train.density.prune_scale": ("experiments.train.gradient.prune_scale",),
    "train.density.opacity_reset_interval": ("experiments.train.gradient.opacity_reset_interval",),
    "train.density.growth": ("experiments.train.mcmc.growth_share",),
    "train.density.noise": ("experiments.train.mcmc.noise",),
    "train.density.opacity_cost": ("experiments.train.mcmc.opacity_loss_weight",),
    "train.density.scale_cost": ("experiments.train.mcmc.scale_loss_weight",),
    "export.morton_order": ("experiments.export.morton_order",),
    "report.views": ("experiments.report.views",),
}


def renamed(path: str) -> list[str]:
    """One line for each old option at or below ``path`` that says its new name."""
    return [
        f"{old} is now {' or '.join(new)}"
        for old, new in RENAMED.items()
        if old == path or old.startswith(f"{path}.")
    ]
