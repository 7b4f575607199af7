"""Scenes for the rasterizer's tests."""

from __future__ import annotations

import torch

from pipeline.render import RasterCamera

Scene = tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]
NAMES = ("means", "log_scales", "quats", "opacity_logits", "sh")


def camera(width: int, height: int, *, rotated: bool = False) -> RasterCamera:
    """A camera near the origin that faces along z, with an off-centre principal point."""
    pose = torch.eye(4, dtype=torch.float64)
    if rotated:
        c, s = torch.cos(torch.tensor(0.3)).item(), torch.sin(torch.tensor(0.3)).item()
        pose[:3, :3] = torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]], dtype=torch.float64)
        pose[:3, 3] = torch.tensor([0.4, -0.2, 0.3])
    return RasterCamera(width, height, 0.9 * width, 0.95 * width, 0.48 * width, 0.53 * height, pose)


def random_scene(seed: int, count: int, *, degree: int = 3, size: float = 0.07) -> Scene:
    """Gaussians of scale about ``size`` in front of ``camera``, some outside the image, float32."""
    gen = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=gen)

    means = normal(count, 3) * torch.tensor([1.4, 1.1, 1.0]) + torch.tensor([0.0, 0.0, 4.0])
    log_scales = normal(count, 3) * 0.5 + torch.tensor(size).log()
    sh = normal(count, (degree + 1) ** 2, 3) * 0.25
    return means, log_scales, normal(count, 4), normal(count) * 1.5, sh


def relative(found: torch.Tensor, expected: torch.Tensor) -> float:
    """Relative L2 distance."""
    expected = expected.double()
    return float((found.double() - expected).norm() / expected.norm().clamp(min=1e-30))
