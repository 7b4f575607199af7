"""The values of the presets, which replace defaults of the schema."""

from __future__ import annotations

from typing import Any

# balanced is the schema itself: minutes on two cores. fast is a first look. high trains the papers'
# 30 000 steps at full resolution, with densification over the first half.
#
# original is 3D Gaussian splatting as published: the defaults of the authors' implementation
# (https://github.com/graphdeco-inria/gaussian-splatting, arguments/__init__.py of 2023). Its
# density control is the strategy ``original``.
PRESETS: dict[str, dict[str, Any]] = {
    "fast": {
        "views": {"max_long_side_px": 640},
        "features": {"max_features": 3000, "max_long_side_px": 1200},
        "init": {"method": "points"},
        "train": {"steps": 1500, "density": {"pixels_per_gaussian": 4.0}},
    },
    "balanced": {},
    "high": {
        "views": {"max_long_side_px": 1600},
        "features": {"max_features": 8192, "max_long_side_px": 2400},
        "train": {"steps": 30_000},
        "experiments": {
            "train": {
                "coarse_share": 0.2,
                "learning_rate_final_factor": 1.0,
                "shN_learning_rate": 1.25e-4,
                "gradient": {"stop_share": 0.5, "recycle_share": 0.0},
                "mcmc": {"stop_share": 0.5},
            }
        },
    },
    "original": {
        "views": {"max_long_side_px": 1600},
        "init": {"method": "points", "max_points": 10_000_000},
        "train": {
            "steps": 30_000,
            "appearance": "none",
            "ssim_loss_weight": 0.2,
            "depth_loss_weight": 0.0,
            "density": {"strategy": "original"},
        },
        "experiments": {
            "init": {"opacity": 0.1},
            "train": {
                "coarse_share": 0.0,
                "sh_degree_interval": 1000,
                "squared_error_loss_weight": 0.0,
                "alpha_loss_weight": 0.0,
                "mask_loss_weight": 0.0,
                "clamp_color_gradient": True,
                "dropout": 0.0,
                "views_per_sh_coefficient": 0.0,
                "adam_beta1": 0.9,
                "adam_epsilon": 0.0,
                "means_learning_rate_unit": "camera_extent",
                "means_learning_rate": 1.6e-4,
                "means_final_learning_rate": 1.6e-6,
                "scales_learning_rate": 5e-3,
                "quats_learning_rate": 1e-3,
                "opacities_learning_rate": 5e-2,
                "sh0_learning_rate": 2.5e-3,
                "shN_learning_rate": 1.25e-4,
                "learning_rate_factor": 1.0,
                "learning_rate_final_factor": 1.0,
            },
        },
    },
}
