"""The gradients of the reference implementation equal finite differences in float64."""

from __future__ import annotations

import pytest
import torch

from pipeline.render import RasterOptions, reference
from tests.render.scenes import camera, random_scene

CAMERA = camera(11, 9, rotated=True)


def doubles(count: int = 6, seed: int = 3, size: float = 0.4) -> list[torch.Tensor]:
    return [t.double().requires_grad_() for t in random_scene(seed, count, size=size)]


@pytest.mark.parametrize("antialias", [False, True])
def test_gradient_of_the_projection(antialias: bool) -> None:
    options = RasterOptions(antialias=antialias)
    scene = doubles()
    # Two Gaussians outside the image: the clamp of the Jacobian is tested, too.
    with torch.no_grad():
        scene[0][0] = torch.tensor([3.5, 0.1, 4.5])
        scene[0][1] = torch.tensor([0.1, -5.0, 4.5])
        scene[1][:2] = 0.2

    def outputs(*inputs: torch.Tensor) -> tuple[torch.Tensor, ...]:
        p = reference.project(*inputs, scene[4].detach(), CAMERA, options)
        return p.means2d, p.conics, p.depths, p.opacities

    assert reference.project(*scene, CAMERA, options).index.tolist() == list(range(6))
    assert torch.autograd.gradcheck(outputs, scene[:4], eps=1e-6, atol=1e-7)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_gradient_of_the_sh_colors(degree: int) -> None:
    means, _, _, _, sh = doubles()
    assert torch.autograd.gradcheck(
        lambda m, s: reference.sh_colors(m, s, CAMERA, degree), [means, sh], eps=1e-6, atol=1e-8
    )


def test_gradient_of_the_camera() -> None:
    """The projection and the colours depend on the camera, the latter on its centre."""
    scene = [t.detach() for t in doubles()]

    def outputs(change: torch.Tensor) -> tuple[torch.Tensor, ...]:
        cam = reference.perturbed(CAMERA, change)
        p = reference.project(*scene, cam, RasterOptions())
        return p.means2d, p.conics, p.depths, reference.sh_colors(scene[0], scene[4], cam, 3)

    change = torch.zeros(10, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(outputs, [change], eps=1e-6, atol=1e-7)
    # A rotation of the camera to the right by 90 degrees moves a point ahead to the left.
    quarter = torch.zeros(10, dtype=torch.float64)
    quarter[1] = -torch.pi / 2
    ahead = torch.tensor([0.0, 0.0, 1.0, 0.0], dtype=torch.float64)
    turned = reference.perturbed(camera(11, 9), quarter).world_to_camera
    assert torch.allclose(turned @ ahead, torch.tensor([-1.0, 0, 0, 0], dtype=torch.float64))


@pytest.mark.parametrize("background", [None, (0.2, 0.4, 0.9)])
def test_gradient_of_blending(background: tuple[float, float, float] | None) -> None:
    options = RasterOptions(background=background)
    scene, cam = doubles(size=0.15), camera(7, 6, rotated=True)
    with torch.no_grad():
        p = reference.project(*scene, cam, options)
        assert len(p.index) >= 5
        colors = reference.sh_colors(scene[0][p.index], scene[4][p.index], cam, 3)
        blended = reference.blend(p, colors, cam, options)
        assert blended.margin.min() > 1e-4  # no threshold is close

    def image(*inputs: torch.Tensor) -> tuple[torch.Tensor, ...]:
        moved = reference.Projection(p.index, *inputs[:4], p.radii, 0)
        b = reference.blend(moved, inputs[4], cam, options)
        return b.color, b.alpha, b.depth

    inputs = [p.means2d, p.conics, p.depths, p.opacities, colors]
    inputs = [t.detach().clone().requires_grad_() for t in inputs]
    assert torch.autograd.gradcheck(image, inputs, eps=1e-7, atol=1e-6)


@pytest.mark.parametrize("masked", [False, True])
def test_gradient_of_the_loss(masked: bool) -> None:
    gen = torch.Generator().manual_seed(0)
    rendered = torch.rand(7, 6, 3, generator=gen, dtype=torch.float64).requires_grad_()
    target = torch.rand(7, 6, 3, generator=gen, dtype=torch.float64)
    mask = torch.rand(7, 6, generator=gen) > 0.7 if masked else None
    assert torch.autograd.gradcheck(
        lambda r: reference.l1_ssim(r, target, 0.2, mask, 1.5)[0], [rendered], eps=1e-6, atol=1e-9
    )


def test_sh_basis_is_orthonormal() -> None:
    """The inner products on the sphere reveal wrong constants and signs."""
    nodes, weights = (torch.tensor(v) for v in __import__("numpy").polynomial.legendre.leggauss(8))
    phi = torch.arange(16, dtype=torch.float64) * (2 * torch.pi / 16)
    z, angle = torch.meshgrid(nodes, phi, indexing="ij")
    ring = (1 - z * z).sqrt()
    directions = torch.stack([ring * angle.cos(), ring * angle.sin(), z], -1).reshape(-1, 3)
    area = (weights[:, None] * torch.full_like(angle, 2 * torch.pi / 16)).reshape(-1)
    basis = reference.sh_basis(directions, 3)
    gram = basis.T @ (basis * area[:, None])
    assert torch.allclose(gram, torch.eye(16, dtype=torch.float64), atol=1e-12)
