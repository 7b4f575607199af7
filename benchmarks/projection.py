"""Error of the projection of single Gaussians against rays: which rule leaves out those for which
the linearisation fails.

    python -m benchmarks.projection

Random Gaussians around a camera are drawn one at a time, and the image is compared with the truth:
in each pixel, the opacity times the largest density along the ray in front of the near plane
(Moenne-Loccoz et al. 2024, "3D Gaussian Ray Tracing", section 4.1). The error is the mean over the
view's pixels of the absolute difference, so that a veil over the whole view counts as its opacity.
Compared are rules for what is not drawn, and the unscented transform (Wu et al. 2025, "3DGUT").
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from benchmarks import markdown
from pipeline.render import RasterCamera
from pipeline.render.reference import ALPHA_MIN, DILATION, rotation_from_quat

OPACITY = 0.96
NEAR = 0.01
CHUNK = 500
#: Distance of the unscented transform's sigma points, in standard deviations: sqrt(3).
UNSCENTED_REACH = 3**0.5


@dataclass(frozen=True)
class Around:
    """Gaussians around a camera at the origin that faces along z, float64.

    Attributes:
        means: (N, 3), also outside the view and behind the camera.
        log_scales, quats: (N, 3) and (N, 4), as those of ``Gaussians``.
    """

    means: Tensor
    log_scales: Tensor
    quats: Tensor

    @property
    def axes(self) -> Tensor:
        """(N, 3, 3) the standard deviations along the Gaussian's axes, as columns."""
        return rotation_from_quat(self.quats) * self.log_scales.exp().unsqueeze(-2)

    def chunks(self) -> Iterator[Around]:
        parts = zip(*(t.split(CHUNK) for t in vars(self).values()), strict=True)
        return (Around(*part) for part in parts)


def view() -> RasterCamera:
    """A small view with a horizontal field of 62 degrees."""
    return RasterCamera(48, 36, 40.0, 40.0, 24.0, 18.0, torch.eye(4, dtype=torch.float64))


def gaussians_around(count: int, seed: int = 0) -> Around:
    """Gaussians at distances 0.3 to 10 in all directions, most in front, of all shapes, from a
    three hundredth of the distance to three times as large."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(*shape, generator=generator, dtype=torch.float64)

    directions = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    in_front = torch.rand(count, generator=generator) < 0.8
    directions[:, 2] = torch.where(in_front, directions[:, 2].abs(), directions[:, 2])
    distance = uniform(-1.2, 2.3, count, 1).exp()
    log_scales = uniform(-5.8, 1.1, count, 1) + uniform(-2.3, 0.0, count, 3)
    log_scales = log_scales + uniform(0.0, 1.0, count, 1) * distance.log()
    quats = torch.randn(count, 4, generator=generator, dtype=torch.float64)
    return Around(torch.nn.functional.normalize(directions, dim=-1) * distance, log_scales, quats)


def traced(found: Around, camera: RasterCamera) -> Tensor:
    """(N, H W) the truth: opacity times the largest density along each pixel's ray."""
    rays = _rays(camera)
    inverse = torch.linalg.inv(found.axes)  # From the world to where the Gaussian is a unit ball.
    centre = (inverse @ found.means.unsqueeze(-1)).squeeze(-1)
    directions = torch.einsum("nij,pj->npi", inverse, rays)
    t = torch.einsum("npi,ni->np", directions, centre) / directions.square().sum(-1)
    nearest = directions * t.clamp(min=NEAR).unsqueeze(-1) - centre.unsqueeze(1)
    return _alpha(nearest.square().sum(-1))


def linearised(found: Around, camera: RasterCamera) -> Tensor:
    """(N, H W) as ``reference.project``, without a rule for what is not drawn."""
    x, y, z = found.means.unbind(-1)
    min_u, max_u, min_v, max_v = camera.slopes
    u, v, zero = (x / z).clamp(min_u, max_u), (y / z).clamp(min_v, max_v), torch.zeros_like(z)
    rows = [camera.fx / z, zero, -camera.fx * u / z, zero, camera.fy / z, -camera.fy * v / z]
    half = torch.stack(rows, -1).reshape(-1, 2, 3) @ found.axes
    return _ellipses(_pixels(found.means, camera), half @ half.mT, camera)


def unscented(found: Around, camera: RasterCamera) -> Tensor:
    """(N, H W) with the mean and covariance of the projections of seven sigma points."""
    offsets = UNSCENTED_REACH * torch.cat([found.axes, -found.axes], -1).mT
    points = torch.cat([found.means.unsqueeze(1), found.means.unsqueeze(1) + offsets], 1)
    pixels = _pixels(points, camera)
    weights = torch.full((7,), 1 / 6, dtype=torch.float64)
    weights[0] = 0.0
    centre = (weights[:, None] * pixels).sum(1)
    difference = pixels - centre.unsqueeze(1)
    covariance = torch.einsum("k,nki,nkj->nij", weights, difference, difference)
    return _ellipses(centre, covariance, camera)


def depth_sigmas(found: Around) -> Tensor:
    """(N,) camera z in standard deviations along z: the ellipsoid of fewer is in front."""
    return found.means[:, 2] / found.axes[:, 2].norm(dim=-1)


def off_axis(found: Around, camera: RasterCamera) -> Tensor:
    """(N,) distance of the centre from the axis, in halves of the field of view."""
    x, y, z = found.means.unbind(-1)
    across, down = (
        camera.fx * x / z / (0.5 * camera.width),
        camera.fy * y / z / (0.5 * camera.height),
    )
    return torch.maximum(across.abs(), down.abs())


def camera_sigmas(found: Around) -> Tensor:
    """(N,) Mahalanobis distance of the camera's centre."""
    return torch.linalg.solve(found.axes, found.means.unsqueeze(-1)).squeeze(-1).norm(dim=-1)


def _unscented_in_front(found: Around) -> Tensor:
    """(N,) whether all sigma points are in front of the camera."""
    return (found.means[:, 2:] - UNSCENTED_REACH * found.axes[:, 2].abs()).amin(-1) > NEAR


def _rays(camera: RasterCamera) -> Tensor:
    """(H W, 3) rays through the pixel centres, with z = 1."""
    j, i = torch.meshgrid(
        torch.arange(camera.width, dtype=torch.float64) + 0.5,
        torch.arange(camera.height, dtype=torch.float64) + 0.5,
        indexing="xy",
    )
    x, y = (j - camera.cx) / camera.fx, (i - camera.cy) / camera.fy
    return torch.stack([x, y, torch.ones_like(x)], -1).reshape(-1, 3)


def _pixels(points: Tensor, camera: RasterCamera) -> Tensor:
    focal = torch.tensor([camera.fx, camera.fy], dtype=torch.float64)
    principal = torch.tensor([camera.cx, camera.cy], dtype=torch.float64)
    return focal * points[..., :2] / points[..., 2:] + principal


def _ellipses(centre: Tensor, covariance: Tensor, camera: RasterCamera) -> Tensor:
    covariance = covariance + DILATION * torch.eye(2, dtype=torch.float64)
    difference = _pixels(_rays(camera), camera) - centre.unsqueeze(1)
    solved = torch.linalg.solve(covariance, difference.mT).mT
    return _alpha((difference * solved).sum(-1))


def _alpha(squared_distance: Tensor) -> Tensor:
    alpha = OPACITY * torch.exp(-0.5 * squared_distance)
    return torch.where(alpha >= ALPHA_MIN, alpha, 0.0)


@dataclass(frozen=True)
class Errors:
    """What a method draws, and by how much it is wrong, for the Gaussians in front of the camera.

    Attributes:
        drawn: (N,) sums over the pixels of what the method draws.
        error: (N,) mean over the pixels of the absolute difference from the truth.
        right: (N,) sums of what the truth shows and the method draws as well.
    """

    drawn: Tensor
    error: Tensor
    right: Tensor


def errors(found: Around, camera: RasterCamera, method: Callable[..., Tensor]) -> Errors:
    parts = []
    for chunk in found.chunks():
        drawn, truth = method(chunk, camera), traced(chunk, camera)
        right = torch.minimum(drawn, truth).sum(1)
        parts.append(Errors(drawn.sum(1), (drawn - truth).abs().mean(1), right))
    return Errors(*(torch.cat([vars(part)[name] for part in parts]) for name in vars(parts[0])))


def main() -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.projection", description="Error of the projection against rays."
    )
    parser.add_argument(
        "--count", type=int, default=20_000, help="Gaussians (default: %(default)s)"
    )
    count = parser.parse_args().count
    camera, found = view(), gaussians_around(count)
    front = found.means[:, 2] > NEAR
    found = Around(*(t[front] for t in vars(found).values()))
    every = {"linear": linearised, "unscented": unscented}
    measured = {name: errors(found, camera, method) for name, method in every.items()}
    sigmas, halves, own = depth_sigmas(found), off_axis(found, camera), camera_sigmas(found)
    rules = [("linear", "none", torch.ones_like(sigmas, dtype=torch.bool))]
    rules += [("linear", f"centre within {k:g} half-fields", halves < k) for k in (1.3, 2, 3)]
    rules += [("linear", f"camera outside {k:g} sigma", own > k) for k in (2, 3)]
    rules += [("linear", f"{k:g} sigma in front", sigmas > k) for k in (1, 1.5, 2, 3)]
    rules += [("unscented", "sigma points in front", _unscented_in_front(found))]
    rules += [("unscented", f"{k:g} sigma in front", sigmas > k) for k in (2, 3)]
    rows = [["projection", "drawn", "of them", "error: mean", "99 %", "largest", "right of truth"]]
    for name, rule, kept in rules:
        part = measured[name]
        seen = part.drawn > 0
        error = part.error[kept & seen]
        rows.append([
            name, rule, f"{(kept & seen).sum() / seen.sum():.2f}", f"{error.mean():.4f}",
            f"{error.quantile(0.99):.3f}", f"{error.max():.3f}",
            f"{part.right[kept].sum() / measured['linear'].right.sum():.2f}",
        ])  # fmt: skip
    print(markdown.table(rows))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
