"""Reference implementation of the rasterizer in torch, one function per operator, in any float
dtype.

It documents the method, and tests compare the C++ kernels with it. It follows "3D Gaussian
Splatting for Real-Time Radiance Field Rendering" (Kerbl et al. 2023) and the projection of "EWA
Splatting" (Zwicker et al. 2002). Every function is differentiable by autograd. Memory is
proportional to pixels times Gaussians: for small scenes only.

N Gaussians, V visible ones among them, an image of H x W pixels.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from pipeline.render.types import AlphaChangeLoss, RasterCamera, RasterOptions, Surroundings

# The same constants as in cpu/csrc/constants.h, which has their reasons.
DILATION = 0.3
ALPHA_MIN = 1 / 255
ALPHA_MAX = 0.999
TRANSMITTANCE_MIN = 1e-4
QUAT_NORM2_MIN = 1e-8
COMPENSATION_MIN = 2.5e-5
MIN_DEPTH_SIGMAS = 2.0
COVARIANCE_MAX = 1e30
SH_MAX = 1e6


@dataclass(frozen=True)
class Projection:
    """The visible Gaussians on the image plane, in the order of their index.

    Attributes:
        index: (V,) int64, the index among the N.
        means2d: (V, 2) pixels.
        conics: (V, 3), the inverse 2D covariance's xx, xy, yy, in 1/px^2.
        depths: (V,) camera z.
        opacities: (V,) in (0, 1), including the compensation.
        radii: (N,) pixels; 0 for Gaussians that are not visible.
        num_dropped: Gaussians left out because a value is not finite or degenerate.
    """

    index: Tensor
    means2d: Tensor
    conics: Tensor
    depths: Tensor
    opacities: Tensor
    radii: Tensor
    num_dropped: int


def rotation_from_quat(quats: Tensor) -> Tensor:
    """(N, 4) quaternions (wxyz) of any norm -> (N, 3, 3) rotations (Kerbl et al. 2023, eq. 10)."""
    w, x, y, z = (quats / quats.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, -1).reshape(*quats.shape[:-1], 3, 3)


def perturbed(camera: RasterCamera, change: Tensor) -> RasterCamera:
    """The camera after a ``change`` (10,); the gradient at zero is ``CameraGradients``.

    The first six values are a rotation vector r (radians) and a translation t (world units): a
    point x in the camera's frame moves to exp([r]) x + t, where [r] is the cross product matrix.
    The other four are added to fx, fy, cx, cy, in pixels. The fields of the result are tensors.
    """
    skew = torch.zeros(3, 3, dtype=change.dtype)
    skew = skew.index_put(
        (torch.tensor([2, 0, 1, 1, 2, 0]), torch.tensor([1, 2, 0, 2, 0, 1])),
        torch.cat([change[:3], -change[:3]]),
    )
    left = torch.eye(4, dtype=change.dtype)
    left = torch.cat([torch.cat([torch.linalg.matrix_exp(skew), change[3:6, None]], 1), left[3:]])
    pinhole = [camera.fx, camera.fy, camera.cx, camera.cy]
    intrinsics: list[Any] = [value + change[6 + i] for i, value in enumerate(pinhole)]
    fx, fy, cx, cy = intrinsics
    pose = left @ camera.world_to_camera.to(change.dtype)
    return RasterCamera(camera.width, camera.height, fx, fy, cx, cy, pose)


def project(
    means: Tensor,
    log_scales: Tensor,
    quats: Tensor,
    opacity_logits: Tensor,
    sh: Tensor,
    camera: RasterCamera,
    options: RasterOptions,
) -> Projection:
    """Project 3D Gaussians to 2D Gaussians on the image plane.

    The 3D covariance is Sigma = R S S^T R^T (Kerbl et al., eq. 6). The 2D covariance, to first
    order, is Sigma' = J W Sigma W^T J^T (Zwicker et al., eq. 31) with W the camera's rotation and

        J = [[fx / z, 0, -fx u / z], [0, fy / z, -fy v / z]],  u = x / z, v = y / z.

    In J, u and v are clamped to the image plus 0.3 tan(fov / 2) on each side (1.3 tan(fov / 2) for
    a central principal point): further out the linearisation is inaccurate. Dilation by 0.3 px^2 is
    a low-pass filter; ``antialias`` preserves the energy by scaling the opacity with
    sqrt(det Sigma' / det(Sigma' + 0.3 I)) (Yu et al. 2024, "Mip-Splatting", eq. 9).

    A Gaussian is visible if z > near, its ellipsoid of two standard deviations is in front of the
    camera (z > 2 sigma_z: the perspective image of others is no ellipse), its opacity is at least
    1/255, and the bounding box of the ellipse {alpha >= 1/255} contains a pixel centre.
    """
    dtype = means.dtype
    pose = camera.world_to_camera.to(dtype)
    ok = torch.isfinite(means).all(-1) & torch.isfinite(log_scales).all(-1)
    ok &= torch.isfinite(quats).all(-1) & torch.isfinite(opacity_logits)
    ok &= (quats.double() ** 2).sum(-1) >= QUAT_NORM2_MIN
    index = torch.nonzero(ok).squeeze(-1)
    cam = means[index] @ pose[:3, :3].T + pose[:3, 3]
    in_front = cam[:, 2] > options.near
    index, cam = index[in_front], cam[in_front]
    x, y, z = cam.unbind(-1)

    min_u, max_u, min_v, max_v = camera.slopes
    u, v = (x / z).clamp(min_u, max_u), (y / z).clamp(min_v, max_v)
    zero = torch.zeros_like(z)
    jacobian = torch.stack(
        [camera.fx / z, zero, -camera.fx * u / z, zero, camera.fy / z, -camera.fy * v / z], -1
    ).reshape(-1, 2, 3)
    axes = rotation_from_quat(quats[index]) * log_scales[index].exp().unsqueeze(-2)
    half = jacobian @ pose[:3, :3] @ axes
    cov = half @ half.mT
    xx, xy, yy = cov[:, 0, 0], cov[:, 0, 1], cov[:, 1, 1]
    # Lagrange's identity |a|^2 |b|^2 - (a.b)^2 = |a x b|^2 avoids cancellation for thin Gaussians.
    det_undilated = torch.linalg.cross(half[:, 0], half[:, 1]).square().sum(-1)
    det = det_undilated + DILATION * (xx + yy + DILATION)
    xx, yy = xx + DILATION, yy + DILATION
    opacities = torch.sigmoid(opacity_logits[index])
    if options.antialias:
        opacities = opacities * (det_undilated / det).clamp(min=COMPENSATION_MIN).sqrt()
    means2d = torch.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], -1)

    with torch.no_grad():
        active = sh[index, : (options.sh_degree + 1) ** 2]
        sound = (det > 0) & (xx < COVARIANCE_MAX) & (yy < COVARIANCE_MAX)
        sound &= torch.isfinite(means2d).all(-1)
        # Half the axes of the ellipse {alpha >= 1/255}: x^T conic x <= 2 ln(255 opacity).
        reach2 = 2 * torch.log(opacities / ALPHA_MIN)
        extent = torch.stack([xx, yy], -1).mul(reach2.clamp(min=0).unsqueeze(-1)).sqrt()
        size = torch.tensor([camera.width, camera.height], dtype=dtype)
        first = (means2d - extent - 0.5).ceil().clamp(min=0)
        last = torch.minimum((means2d + extent - 0.5).floor(), size - 1)
        sigma_z = (pose[2, :3] @ axes).norm(dim=-1)
        visible = sound & (z > MIN_DEPTH_SIGMAS * sigma_z)
        visible &= (reach2 > 0) & (first <= last).all(-1)
        good_color = (active.abs() <= SH_MAX).all(-1).all(-1)
        dropped = int((~ok).sum() + (~sound).sum() + (visible & ~good_color).sum())
        visible &= good_color
        mid = 0.5 * (xx + yy)
        longest = mid + (0.25 * (xx - yy) ** 2 + xy * xy).sqrt()
        radii = torch.zeros(means.shape[0], dtype=dtype)
        radii[index[visible]] = (reach2 * longest).sqrt()[visible]
    conics = torch.stack([yy / det, -xy / det, xx / det], -1)
    return Projection(
        index[visible], means2d[visible], conics[visible], z[visible], opacities[visible], radii,
        dropped,
    )  # fmt: skip


def sh_basis(directions: Tensor, degree: int) -> Tensor:
    """Real spherical harmonics of unit (V, 3) directions, degree 0 to 3 -> (V, (degree + 1)^2).

    Ordered and signed as in 3DGS (the Condon-Shortley phase included); the polynomials are those
    of Sloan 2013, "Efficient Spherical Harmonic Evaluation".
    """
    x, y, z = directions.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    terms = [torch.full_like(x, 0.28209479177387814)]
    if degree > 0:
        c = 0.4886025119029199
        terms += [-c * y, c * z, -c * x]
    if degree > 1:
        c = 1.0925484305920792
        terms += [c * x * y, -c * y * z, 0.31539156525252005 * (2 * zz - xx - yy)]
        terms += [-c * x * z, 0.5 * c * (xx - yy)]
    if degree > 2:
        terms += [
            -0.5900435899266435 * y * (3 * xx - yy),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4 * zz - xx - yy),
            0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
            -0.4570457994644658 * x * (4 * zz - xx - yy),
            1.445305721320277 * z * (xx - yy),
            -0.5900435899266435 * x * (xx - 3 * yy),
        ]
    return torch.stack(terms, -1)


class _ClampAtZero(torch.autograd.Function):
    """max(0, x), with the gradient of x below 0 if a gradient step would increase x. 3DGS uses the
    plain clamp (``RasterOptions.clamp_color_gradient``), with which a Gaussian that is black in all
    views stays black."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        ctx.save_for_backward(x)
        return x.clamp(min=0)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Tensor:  # type: ignore[override]
        (x,) = ctx.saved_tensors
        return torch.where(x > 0, grad, grad.clamp(max=0))


def sh_colors(
    means: Tensor, sh: Tensor, camera: RasterCamera, degree: int, clamp_gradient: bool = False
) -> Tensor:
    """(V, 3) RGB as seen from the camera: max(0, 0.5 + sum_k basis_k(direction) sh_k).

    The direction is from the camera's centre to the mean; the gradient includes its dependence on
    the mean. A clamped colour receives only gradients that would increase it (``_ClampAtZero``), or
    none with ``clamp_gradient``.
    """
    pose = camera.world_to_camera.to(means.dtype)
    center = -pose[:3, :3].T @ pose[:3, 3]
    basis = sh_basis(F.normalize(means - center, dim=-1, eps=1e-30), degree)
    colors = (basis.unsqueeze(-1) * sh[:, : basis.shape[1]]).sum(1) + 0.5
    if clamp_gradient:
        return torch.relu(colors)
    clamped: Tensor = _ClampAtZero.apply(colors)
    return clamped


@dataclass(frozen=True)
class Blend:
    """A composited image.

    Attributes:
        color: (H, W, 3), including the background.
        alpha, depth, median_depth: (H, W), see ``Forward``.
        margin: (H, W), the smallest relative distance of a pixel to a threshold of the method
            (alpha at 1/255 and at its maximum, transmittance at its minimum). If it is small,
            different rounding may change the pixel.
        pairs: The number of contributing (pixel, Gaussian) pairs.
    """

    color: Tensor
    alpha: Tensor
    depth: Tensor
    median_depth: Tensor
    margin: Tensor
    pairs: int


def blend(
    projection: Projection, colors: Tensor, camera: RasterCamera, options: RasterOptions
) -> Blend:
    """Front to back alpha compositing (Kerbl et al. 2023, eq. 3).

        alpha_i = min(opacity_i exp(-d^T conic_i d / 2), 0.999), skipped below 1/255
        T_i = prod_{j < i} (1 - alpha_j),  C = sum_i T_i alpha_i c_i + T_n background

    in order of depth, equal depths by index. A pixel stops before the Gaussian that would lower its
    transmittance below 1e-4.
    """
    dtype, height, width = colors.dtype, camera.height, camera.width
    order = torch.sort(projection.depths.detach().float(), stable=True).indices
    center, conic = projection.means2d[order], projection.conics[order]
    depth, color = projection.depths[order], colors[order]
    grid_y, grid_x = torch.meshgrid(
        torch.arange(height, dtype=dtype) + 0.5, torch.arange(width, dtype=dtype) + 0.5,
        indexing="ij",
    )  # fmt: skip
    dx = grid_x.reshape(-1, 1) - center[:, 0]
    dy = grid_y.reshape(-1, 1) - center[:, 1]
    power = -0.5 * (conic[:, 0] * dx * dx + conic[:, 2] * dy * dy) - conic[:, 1] * dx * dy
    raw = projection.opacities[order] * power.exp()
    alpha = torch.where(raw >= ALPHA_MIN, raw.clamp(max=ALPHA_MAX), torch.zeros_like(raw))
    # Transmittance is monotonic: a comparison with the running product finds where a pixel stops.
    alive = torch.cumprod(1 - alpha, 1) >= TRANSMITTANCE_MIN
    used = torch.where(alive, alpha, torch.zeros_like(alpha))
    after = torch.cumprod(1 - used, 1)
    before = torch.cat([torch.ones_like(after[:, :1]), after[:, :-1]], 1)
    weight = before * used

    rgb = weight @ color
    opaque = weight.sum(1)
    if options.background is not None:
        rgb = rgb + (1 - opaque).unsqueeze(-1) * torch.tensor(options.background, dtype=dtype)
    with torch.no_grad():
        crossing = (before >= 0.5) & (after < 0.5)
        median = (crossing * depth).sum(1)
        running = torch.cumprod(1 - alpha, 1)
        reached = torch.cat([torch.ones_like(alive[:, :1]), alive[:, :-1]], 1)
        near_cut = torch.minimum((raw / ALPHA_MIN - 1).abs(), (raw / ALPHA_MAX - 1).abs())
        near_stop = (running / TRANSMITTANCE_MIN - 1).abs()
        margin = torch.where(reached, torch.minimum(near_cut, near_stop), 1.0)
        margin = (
            torch.cat([torch.ones_like(margin[:, :1]), margin], 1).amin(1)
            if (margin.shape[1])
            else torch.ones(height * width, dtype=dtype)
        )
    shape = (height, width)
    return Blend(
        rgb.reshape(height, width, 3), opaque.reshape(shape), (weight @ depth).reshape(shape),
        median.reshape(shape), margin.reshape(shape), int((used > 0).sum()),
    )  # fmt: skip


def draw(
    means: Tensor, sh: Tensor, projection: Projection, camera: RasterCamera, options: RasterOptions
) -> Blend:
    """Composite projected Gaussians with the means (N, 3) and SH coefficients (N, K, 3)."""
    visible, clamp = projection.index, options.clamp_color_gradient
    colors = sh_colors(means[visible], sh[visible], camera, options.sh_degree, clamp)
    return blend(projection, colors, camera, options)


def render(
    means: Tensor,
    log_scales: Tensor,
    quats: Tensor,
    opacity_logits: Tensor,
    sh: Tensor,
    camera: RasterCamera,
    options: RasterOptions,
) -> tuple[Projection, Blend]:
    """Render a view, differentiable by autograd."""
    projection = project(means, log_scales, quats, opacity_logits, sh, camera, options)
    return projection, draw(means, sh, projection, camera, options)


SSIM_WINDOW, SSIM_SIGMA = 11, 1.5
SSIM_C1, SSIM_C2 = 0.01**2, 0.03**2


def l1_ssim(
    rendered: Tensor,
    target: Tensor,
    ssim_weight: float,
    mask: Tensor | None = None,
    l2_weight: float = 0.0,
) -> tuple[Tensor, Tensor, Tensor]:
    """(1 - w) E + w (1 - SSIM) -> (loss, E, ssim), scalars.

    E is the mean of |d| + k d^2 (k = ``l2_weight``); with k = 0 it is the L1 loss of 3DGS. The
    squared term gives large errors, such as highlights, more weight.

    SSIM (Wang et al. 2004, eq. 13) uses an 11 x 11 Gaussian window of sigma 1.5 with zero padding,
    and its mean is over pixels and channels. Values are in [0, 1]. Masked pixels (True = ignored)
    of the rendered image are replaced by the target's, and both means are over the other pixels.
    """
    dtype = rendered.dtype
    truth = target.to(dtype) / 255 if target.dtype == torch.uint8 else target.to(dtype)
    valid = torch.ones(rendered.shape[:2], dtype=dtype)
    if mask is not None:
        valid = 1 - mask.to(dtype)
        rendered = torch.where(mask.bool().unsqueeze(-1), truth, rendered)
    count = valid.sum() * 3
    if count == 0:
        zero = (rendered * 0).sum()
        return zero, zero, zero + 1
    steps = torch.arange(SSIM_WINDOW, dtype=dtype) - SSIM_WINDOW // 2
    window = torch.exp(-(steps**2) / (2 * SSIM_SIGMA**2))
    window = window / window.sum()
    kernel = torch.outer(window, window)[None, None]

    def blur(image: Tensor) -> Tensor:
        planes = image.permute(2, 0, 1).unsqueeze(1)
        return F.conv2d(planes, kernel, padding=SSIM_WINDOW // 2).squeeze(1).permute(1, 2, 0)

    mu_x, mu_y = blur(rendered), blur(truth)
    var_x = blur(rendered * rendered) - mu_x**2
    var_y = blur(truth * truth) - mu_y**2
    cov = blur(rendered * truth) - mu_x * mu_y
    ssim_map = ((2 * mu_x * mu_y + SSIM_C1) * (2 * cov + SSIM_C2)) / (
        (mu_x**2 + mu_y**2 + SSIM_C1) * (var_x + var_y + SSIM_C2)
    )
    d = rendered - truth
    error = ((d.abs() + l2_weight * d * d) * valid.unsqueeze(-1)).sum() / count
    ssim = (ssim_map * valid.unsqueeze(-1)).sum() / count
    return (1 - ssim_weight) * error + ssim_weight * (1 - ssim), error, ssim


def mean_squared_error(rendered: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """The mean squared error of the images of ``l1_ssim``, over the other pixels than the masked
    ones; 0 if there are none."""
    truth = target.to(rendered.dtype)
    if target.dtype == torch.uint8:
        truth = truth / 255
    squares = (rendered - truth).square()
    squares = squares if mask is None else squares[~mask.bool()]
    return squares.mean() if squares.numel() else squares.sum()


def compose(around: Surroundings, color: Tensor, alpha: Tensor) -> Tensor:
    """(H, W, 3) image of a scene, of which one part is rendered; see ``Backend.compose``."""
    image = color + (1 - alpha)[..., None] * around.behind / 255
    if around.front is not None and around.transmittance is not None:
        image = image * around.transmittance[..., None] / 255 + around.front / 255
    return image if around.correction is None else image + around.correction / 255


def alpha_change_loss(around: Surroundings, alpha: Tensor, loss: AlphaChangeLoss) -> Tensor:
    """See ``AlphaChangeLoss``."""
    change = alpha - around.alpha.to(alpha.dtype) / 255
    beyond = (change - loss.growth).clamp(min=0) + (-loss.fade - change).clamp(min=0)
    return loss.weight * beyond.square().mean()
