"""A training step of gsplat (https://github.com/nerfstudio-project/gsplat), for comparison."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import torch
from torch.nn import functional

from benchmarks.raster.scenes import Scene

WINDOW = 11  # Of SSIM, pixels, with a Gaussian of sigma 1.5.
SSIM_WEIGHT = 0.2


def gsplat_step(scene: Scene, target: torch.Tensor, built: Path) -> Callable[[], object]:
    """A function that makes a step: rendering, L1 and SSIM, gradients and Adam on all parameters.
    It returns when the card has finished.

    Args:
        target: (H, W, 3) float32.
        built: The folder that gsplat was installed into.
    """
    sys.path.insert(0, str(built))
    from gsplat import rasterization

    camera = scene.camera
    parameters = [tensor.cuda().requires_grad_() for tensor in scene.gaussians]
    means, log_scales, quats, logits, sh = parameters
    optimiser = torch.optim.Adam(parameters, lr=0.0, fused=True)
    lens = [[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]]
    lenses = torch.tensor([lens], device="cuda")
    poses = camera.world_to_camera.float().cuda()[None]
    photograph = target.cuda().permute(2, 0, 1)[None]
    degree = round(sh.shape[1] ** 0.5) - 1

    def step() -> None:
        rendered, _, _ = rasterization(
            means, quats, log_scales.exp(), logits.sigmoid(), sh, poses, lenses,
            camera.width, camera.height, sh_degree=degree, packed=False,
        )  # fmt: skip
        image = rendered.permute(0, 3, 1, 2)
        ssim_loss = 1 - _ssim(image, photograph)
        loss = (1 - SSIM_WEIGHT) * (image - photograph).abs().mean() + SSIM_WEIGHT * ssim_loss
        loss.backward()
        optimiser.step()
        optimiser.zero_grad(set_to_none=True)
        torch.cuda.synchronize()

    return step


def _ssim(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    offsets = torch.arange(WINDOW, device=a.device) - WINDOW // 2
    line = torch.exp(-(offsets**2) / (2 * 1.5**2))
    line = (line / line.sum()).expand(3, 1, 1, WINDOW)

    def blur(x: torch.Tensor) -> torch.Tensor:
        x = functional.conv2d(x, line, padding=(0, WINDOW // 2), groups=3)
        return functional.conv2d(x, line.transpose(2, 3), padding=(WINDOW // 2, 0), groups=3)

    mean_a, mean_b = blur(a), blur(b)
    var_a, var_b = blur(a * a) - mean_a**2, blur(b * b) - mean_b**2
    both = blur(a * b) - mean_a * mean_b
    top = (2 * mean_a * mean_b + 0.01**2) * (2 * both + 0.03**2)
    return (top / ((mean_a**2 + mean_b**2 + 0.01**2) * (var_a + var_b + 0.03**2))).mean()
