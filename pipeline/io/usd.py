"""OpenUSD (.usdc): Gaussians as a ``ParticleField3DGaussianSplat``, which USD has since 26.03.

The file needs the package usd-core, which is an extra of its own. Coordinates are those of the
world; the transformation of ``/Scene`` turns it upright, y up. Source: USD's schema of the domain
UsdVol (openusd.org).
"""

from __future__ import annotations

import os
from importlib.util import find_spec
from pathlib import Path
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from pipeline.io.splat_codec import sigmoid
from pipeline.runtime.errors import UserError
from pipeline.runtime.layout import install_extra
from pipeline.splats.arrays import NAMES, GaussianSource

SUFFIX = ".usdc"
#: The up direction of COLMAP's world: that of a camera at the identity.
CAMERA_UP = np.array([0.0, -1.0, 0.0])
#: The half sides of the box of a Gaussian, in its largest standard deviations.
_REACH = 3.0
# SH of degree 3 takes 192 bytes a Gaussian, and readers with 32-bit sizes read arrays below 2 GiB.
_MAX_GAUSSIANS = 10_000_000


def check_usd() -> None:
    """Raises: UserError: The package usd-core is not installed."""
    if find_spec("pxr") is None:
        raise UserError("OpenUSD files need the package usd-core", fix=install_extra("usd"))


def write_usd(path: Path, gaussians: GaussianSource, up: NDArray[np.float64] = CAMERA_UP) -> None:
    """Write Gaussians atomically; the same Gaussians, the same bytes.

    Args:
        up: (3,) unit vector, up in the world.

    Raises:
        UserError: usd-core is not installed, there are no Gaussians, or more than 10 million.
    """
    check_usd()
    from pxr import Gf, Usd, UsdGeom, UsdVol, Vt

    count = len(gaussians)
    if not 0 < count <= _MAX_GAUSSIANS:
        raise UserError(
            f"an OpenUSD file holds 1 to {_MAX_GAUSSIANS:,} Gaussians, found {count:,}",
            file=path,
            fix="set export.max_gaussians, or write another format",
        )
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}{SUFFIX}")
    temporary.unlink(missing_ok=True)
    try:
        stage = Usd.Stage.CreateNew(str(temporary))
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        root = UsdGeom.Xform.Define(stage, "/Scene")
        stage.SetDefaultPrim(root.GetPrim())
        turned = np.eye(4)
        # USD multiplies rows by matrices.
        turned[:3, :3] = _upright(up).T
        root.AddTransformOp().Set(Gf.Matrix4d(turned.tolist()))
        field = UsdVol.ParticleField3DGaussianSplat.Define(stage, "/Scene/Gaussians")
        values = _Values(gaussians)
        field.CreatePositionsAttr(Vt.Vec3fArray.FromNumpy(values.means))
        field.CreateScalesAttr(Vt.Vec3fArray.FromNumpy(values.scales))
        # Quatf lies in memory as x, y, z, w.
        field.CreateOrientationsAttr(Vt.QuatfArray.FromNumpy(values.xyzw))
        field.CreateOpacitiesAttr(Vt.FloatArray.FromNumpy(values.opacities))
        field.CreateRadianceSphericalHarmonicsDegreeAttr(gaussians.sh_degree)
        coefficients = field.CreateRadianceSphericalHarmonicsCoefficientsAttr()
        coefficients.Set(Vt.Vec3fArray.FromNumpy(values.sh))
        field.CreateExtentAttr(values.extent)
        # As in training: an ellipse by perspective at the centre, sorted by depth.
        field.CreateProjectionModeHintAttr("perspective")
        field.CreateSortingModeHintAttr("zDepth")
        stage.GetRootLayer().Save()
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


class _Values:
    """The arrays of a ``ParticleField3DGaussianSplat``, float32."""

    def __init__(self, gaussians: GaussianSource):
        count, width = len(gaussians), (gaussians.sh_degree + 1) ** 2
        self.means, self.scales = np.empty((2, count, 3), np.float32)
        self.xyzw = np.empty((count, 4), np.float32)
        self.opacities = np.empty(count, np.float32)
        sh = np.empty((count, width, 3), np.float32)
        start, low, high = 0, np.full(3, np.inf), np.full(3, -np.inf)
        for means, log_scales, quats, logits, coefficients in gaussians.chunks(*NAMES):
            rows = slice(start, start + len(means))
            norm = np.linalg.norm(quats, axis=1, keepdims=True)
            unit = np.where(norm > 0, quats / np.maximum(norm, 1e-30), (1, 0, 0, 0))
            self.means[rows], self.scales[rows] = means, np.exp(log_scales)
            self.xyzw[rows] = unit[:, [1, 2, 3, 0]]
            self.opacities[rows], sh[rows] = sigmoid(logits), coefficients
            reach = _REACH * self.scales[rows].max(1, keepdims=True)
            low = np.minimum(low, (means - reach).min(0))
            high = np.maximum(high, (means + reach).max(0))
            start += len(means)
        self.sh = sh.reshape(-1, 3)
        self.extent = [tuple(map(float, low)), tuple(map(float, high))]


def _upright(up: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3, 3) rotation that turns ``up`` to y; COLMAP's world by 180 degrees about x."""
    other = np.eye(3)[np.argmin(np.abs(up))]
    z = np.cross(other, up)
    z /= np.linalg.norm(z)
    return np.stack([np.cross(up, z), up, z])


def refuse_usd(path: Path) -> NoReturn:
    """OpenUSD files are written, not read."""
    raise UserError(
        "OpenUSD files are written, not read",
        file=path,
        fix="name the PLY file that it was made of",
    )
