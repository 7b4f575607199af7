"""splatmake: photographs in; camera poses, a trained 3D Gaussian scene and its metrics out.

import splatmake

scene = splatmake.load("results/garden")
print(scene.measure().psnr)
"""

from pipeline.api import (
    Gaussians,
    Quality,
    Render,
    Scene,
    UserError,
    View,
    load,
    psnr,
    read_gaussians,
    ssim,
    write_gaussians,
)

__all__ = [
    "Gaussians",
    "Quality",
    "Render",
    "Scene",
    "UserError",
    "View",
    "load",
    "psnr",
    "read_gaussians",
    "ssim",
    "write_gaussians",
]
