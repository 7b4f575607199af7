"""Scenes for the rasterizer's tests."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import torch

from pipeline.render import RasterCamera, RasterOptions, Surroundings, reference
from pipeline.splats.init import SH_C0

Scene = tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]
IMAGES = ("color", "alpha", "depth", "median_depth")
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


def random_surroundings(height: int, width: int, front: bool, correction: bool) -> Surroundings:
    """Random layers around a block."""
    torch.manual_seed(0)

    def plane(*channels: int) -> torch.Tensor:
        return torch.randint(0, 256, (height, width, *channels), dtype=torch.uint8)

    signed = torch.randint(-127, 128, (height, width, 3), dtype=torch.int8)
    return Surroundings(
        plane(3),
        plane(),
        plane(3) if front else None,
        plane() if front else None,
        signed if correction else None,
    )


def relative(found: torch.Tensor, expected: torch.Tensor) -> float:
    """Relative L2 distance."""
    expected = expected.double()
    return float((found.double() - expected).norm() / expected.norm().clamp(min=1e-30))


CAMERA_PARTS = {
    "rotation": slice(0, 3), "translation": slice(3, 6), "focal": slice(6, 8),
    "principal": slice(8, 10),
}  # fmt: skip


@dataclass(frozen=True)
class Case:
    """A scene and a view, with the results of the float64 reference."""

    seed: int
    count: int
    image_size: tuple[int, int]
    options: RasterOptions
    gaussian_size: float = 0.07

    @cached_property
    def scene(self) -> Scene:
        return random_scene(self.seed, self.count, size=self.gaussian_size)

    @cached_property
    def camera(self) -> RasterCamera:
        return camera(*self.image_size, rotated=self.seed % 2 == 1)

    @cached_property
    def inputs(self) -> list[torch.Tensor]:
        """The parameters and the change of the camera, in float64."""
        change = torch.zeros(10, dtype=torch.float64)
        return [t.double().requires_grad_() for t in (*self.scene, change)]

    @cached_property
    def rendered(self) -> tuple[reference.Projection, reference.Blend]:
        moved = reference.perturbed(self.camera, self.inputs[5])
        return reference.render(*self.inputs[:5], camera=moved, options=self.options)

    @cached_property
    def sure(self) -> torch.Tensor:
        """The pixels that are not close to a threshold of the method, at which rounding decides."""
        sure = self.rendered[1].margin > 1e-5
        assert sure.double().mean() > 0.99
        return sure

    @cached_property
    def incoming(self) -> list[torch.Tensor]:
        """Gradients on color, alpha and depth, zero in pixels that are not sure."""
        gen, image = torch.Generator().manual_seed(self.seed + 100), self.rendered[1]
        color, alpha, depth = (
            torch.randn(part.shape, generator=gen)
            for part in (image.color, image.alpha, image.depth)
        )
        return [color * self.sure[..., None], alpha * self.sure, depth * self.sure]

    def check_images(self, found: Mapping[str, torch.Tensor], colours: float = 2e-6) -> None:
        """Compare color, alpha, depth, median_depth and radii; ``colours`` is the tolerance of the
        first two."""
        projection, image = self.rendered
        assert torch.equal(torch.nonzero(found["radii"])[:, 0], projection.index)
        assert (found["radii"] - projection.radii).abs().max() <= 1e-4
        assert (found["color"] - image.color).abs().amax(-1)[self.sure].max() <= colours
        assert (found["alpha"] - image.alpha).abs()[self.sure].max() <= colours
        assert (found["depth"] - image.depth).abs()[self.sure].max() <= 2e-5
        assert (found["median_depth"] - image.median_depth).abs()[self.sure].max() <= 1e-5

    def check_gradients(
        self, found: Mapping[str, torch.Tensor], incoming: Sequence[torch.Tensor | None]
    ) -> None:
        """Compare the gradients of the parameters, of means2d and, if they are among them, of the
        colors and the camera (10,), to a relative error of 1e-5; ``incoming`` as the attribute."""
        projection, image = self.rendered
        total = torch.zeros((), dtype=torch.float64)
        for part, weight in zip((image.color, image.alpha, image.depth), incoming, strict=True):
            total = total + (0 if weight is None else (part * weight).sum())
        *gradients, d_camera, d_means2d = torch.autograd.grad(
            total, [*self.inputs, projection.means2d], retain_graph=True
        )
        for name, value in zip(NAMES, gradients, strict=True):
            assert relative(found[name], value) <= 1e-5, name
        assert relative(found["means2d"][projection.index], d_means2d) <= 1e-5
        # The constant basis function is the same for every direction.
        if "colors" in found:
            assert relative(found["colors"], gradients[4][:, 0] / SH_C0) <= 1e-5
        if "camera" in found:
            for name, part in CAMERA_PARTS.items():
                assert relative(found["camera"][part], d_camera[part]) <= 1e-5, name
