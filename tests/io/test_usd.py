"""OpenUSD files hold the Gaussians, upright, and pass USD's own validators."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.io import usd
from pipeline.io.splat_files import read_gaussians, write_gaussians
from pipeline.io.usd import check_usd, write_usd
from pipeline.runtime.errors import UserError
from tests.splats.samples import sample
from tests.tools import need_package


def opened(path):
    from pxr import Usd, UsdVol

    stage = Usd.Stage.Open(str(path))
    return stage, UsdVol.ParticleField3DGaussianSplat(stage.GetPrimAtPath("/Scene/Gaussians"))


@pytest.mark.parametrize("degree", [0, 3])
def test_every_value_is_in_the_file(tmp_path, degree):
    need_package("usd-core")
    gaussians = sample(50, degree).as_arrays()
    write_gaussians(tmp_path / "a.usdc", gaussians)
    _, field = opened(tmp_path / "a.usdc")
    assert np.array_equal(np.array(field.GetPositionsAttr().Get()), gaussians.means)
    assert np.allclose(np.array(field.GetScalesAttr().Get()), np.exp(gaussians.log_scales))
    opacities = 1 / (1 + np.exp(-gaussians.opacity_logits.astype(float)))
    assert np.allclose(np.array(field.GetOpacitiesAttr().Get()), opacities, atol=1e-7)
    unit = gaussians.quats / np.linalg.norm(gaussians.quats, axis=1, keepdims=True)
    found = [(q.GetReal(), *q.GetImaginary()) for q in field.GetOrientationsAttr().Get()]
    assert np.allclose(found, unit, atol=1e-6)
    assert field.GetRadianceSphericalHarmonicsDegreeAttr().Get() == degree
    sh = np.array(field.GetRadianceSphericalHarmonicsCoefficientsAttr().Get())
    assert np.array_equal(sh.reshape(gaussians.sh.shape), gaussians.sh)
    low, high = np.array(field.GetExtentAttr().Get())
    assert (low < gaussians.means.min(0)).all() and (gaussians.means.max(0) < high).all()


def test_usds_validators_find_nothing_and_the_same_gaussians_give_the_same_bytes(tmp_path):
    need_package("usd-core")
    from pxr import UsdValidation

    gaussians = sample(50).as_arrays()
    for name in ("a.usdc", "b.usdc"):
        write_usd(tmp_path / name, gaussians)
    assert (tmp_path / "a.usdc").read_bytes() == (tmp_path / "b.usdc").read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.usdc", "b.usdc"]
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    stage, _ = opened(tmp_path / "a.usdc")
    found = UsdValidation.ValidationContext(validators).Validate(stage)
    assert [error.GetMessage() for error in found] == []


@pytest.mark.parametrize("up", [(0, -1, 0), (0, 0, 1), (0, 1, 0), (0.6, 0, 0.8)])
def test_the_stage_stands_upright_without_a_mirror(tmp_path, up):
    need_package("usd-core")
    from pxr import Gf, UsdGeom

    write_usd(tmp_path / "a.usdc", sample(3).as_arrays(), np.array(up, float))
    stage, field = opened(tmp_path / "a.usdc")
    assert UsdGeom.GetStageUpAxis(stage) == "Y" and UsdGeom.GetStageMetersPerUnit(stage) == 1
    matrix = UsdGeom.XformCache().GetLocalToWorldTransform(field.GetPrim())
    assert np.allclose(matrix.Transform(Gf.Vec3d(*map(float, up))), (0, 1, 0), atol=1e-12)
    assert np.isclose(matrix.GetDeterminant(), 1)


def test_without_the_package_the_message_says_how_to_install_it(tmp_path, monkeypatch):
    monkeypatch.setattr(usd, "find_spec", lambda name: None)
    with pytest.raises(UserError, match="usd-core") as caught:
        check_usd()
    assert "pip install" in str(caught.value.fix)


def test_usd_files_are_not_read(tmp_path):
    with pytest.raises(UserError, match="written, not read"):
        read_gaussians(tmp_path / "a.usdc", [])
