"""The Python API: reconstruct a scene from photographs, load it, render it, measure and export it.

import splatmake

scene = splatmake.reconstruct("photos/garden", "scenes", preset="fast")
print(scene.measure())
scene.export("garden.spz")

Nothing is printed unless ``progress=True``. Warnings are Python warnings, and what the input causes
is a ``UserError``.
"""

from __future__ import annotations

from pipeline.metrics.image import psnr, ssim
from pipeline.render.views import Render
from pipeline.runtime.errors import UserError
from pipeline.scene.views import View
from pipeline.splats.gaussians import Gaussians
from pipeline.surface.mesh import Mesh
from splatmake.camera import Camera
from splatmake.files import read_gaussians, write_gaussians
from splatmake.quality import Quality, ViewQuality
from splatmake.reconstruction import reconstruct
from splatmake.scene import Scene, load

__all__ = [
    "Camera",
    "Gaussians",
    "Mesh",
    "Quality",
    "Render",
    "Scene",
    "UserError",
    "View",
    "ViewQuality",
    "load",
    "psnr",
    "read_gaussians",
    "reconstruct",
    "ssim",
    "write_gaussians",
]
