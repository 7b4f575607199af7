"""Other programs read our files: Niantic's and Adobe's SPZ library, PlayCanvas's splat-transform,
gsply, Khronos's glTF validator, glTF Transform. `make test-packages` installs them; tests of
missing ones are skipped."""

from __future__ import annotations

import csv
import json
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.io.gltf import half_turn
from pipeline.io.splat_files import write_gaussians
from pipeline.io.spz import write_spz
from pipeline.splats.gaussians import Gaussians
from tests.io.test_spz import OURS as SPZ
from tests.splats.samples import Within, sample
from tests.tools import need, need_package

HERE = Path(__file__).parent / "independent"
PACKAGES = json.loads((HERE / "package.json").read_text())["dependencies"]
GSPLY = "0.4.6"
EXACT = Within(1e-6, 1e-6, 1e-6, 0.05, 1e-6, 1e-6)
#: splat-transform reads .splat rotations in steps of 1/127.5, the original viewer of 1/128.
SPLAT = Within(0, 2e-6, 0.5001 / 255, 1.8, 0.5001 / 255 / 0.28209, 0)


def needs_node(package: str) -> None:
    need("node")
    found = HERE / "node_modules" / package / "package.json"
    wanted = PACKAGES[package]
    if not found.is_file() or json.loads(found.read_text())["version"] != wanted:
        pytest.skip(f"not run: {package} {wanted} missing (make test-packages)")


def node(*arguments: str | Path) -> str:
    done = subprocess.run(
        ["node", *map(str, arguments)], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def gaussians_of(columns: dict[str, Any]) -> Gaussians:
    """From arrays of another program, with SH coefficients in ``dc`` and ``higher``."""
    dc, higher = np.asarray(columns["dc"]), np.asarray(columns["higher"])
    sh = np.concatenate([dc[:, None], higher.reshape(len(dc), -1, 3)], axis=1)
    names = ("means", "log_scales", "quats", "opacity_logits")
    arrays = {name: np.asarray(columns[name]) for name in names}
    return Gaussians.from_arrays(arrays | {"sh": sh})


def splat_transform(source: Path) -> Gaussians:
    """Read a file with splat-transform."""
    needs_node("@playcanvas/splat-transform")
    table = source.with_suffix(".csv")
    script = HERE / "node_modules/@playcanvas/splat-transform/bin/cli.mjs"
    node(script, "-w", "-q", source, table)
    with open(table, newline="") as file:
        rows = list(csv.DictReader(file))
    column = {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}

    def stack(*names: str) -> np.ndarray:
        return np.stack([column[name] for name in names], axis=1)

    rest = sum(name.startswith("f_rest_") for name in column) // 3
    order = [f"f_rest_{channel * rest + k}" for k in range(rest) for channel in range(3)]
    return gaussians_of(
        {
            "means": stack("x", "y", "z"),
            "log_scales": stack("scale_0", "scale_1", "scale_2"),
            "quats": stack("rot_0", "rot_1", "rot_2", "rot_3"),
            "opacity_logits": column["opacity"],
            "dc": stack("f_dc_0", "f_dc_1", "f_dc_2"),
            "higher": stack(*order) if rest else np.zeros((len(rows), 0)),
        }
    )


@pytest.mark.parametrize("degree", range(4))
def test_niantics_library_reads_our_spz(tmp_path, degree) -> None:
    needs_node("@adobe/spz")
    write_spz(tmp_path / "a.spz", sample(300, degree), antialias=degree == 2)
    found = json.loads(node(HERE / "read.mjs", tmp_path / "a.spz"))
    assert found["shDegree"] == degree and found["antialiased"] == (degree == 2)
    decoded = gaussians_of(
        {
            "means": np.reshape(found["positions"], (-1, 3)),
            "log_scales": np.reshape(found["scales"], (-1, 3)),
            "quats": np.reshape(found["rotations"], (-1, 4))[:, [3, 0, 1, 2]],
            "opacity_logits": [np.inf if a is None else a for a in found["alphas"]],
            "dc": np.reshape(found["colors"], (-1, 3)),
            "higher": np.reshape(found["sh"], (300, -1)),
        }
    )
    SPZ.check(decoded, sample(300, degree))


@pytest.mark.parametrize("degree", range(4))
def test_splat_transform_reads_our_ply(tmp_path, degree) -> None:
    write_gaussians(tmp_path / "a.ply", sample(50, degree))
    EXACT.check(splat_transform(tmp_path / "a.ply"), sample(50, degree))


def test_splat_transform_reads_our_splat(tmp_path) -> None:
    write_gaussians(tmp_path / "a.splat", sample(300))
    SPLAT.check(splat_transform(tmp_path / "a.splat"), sample(300).with_sh_degree(0))


def test_khronos_validator_accepts_our_glb(tmp_path) -> None:
    """It does not support the extension, so its attribute names are the only findings."""
    needs_node("gltf-validator")
    write_gaussians(tmp_path / "a.glb", sample(50))
    found = json.loads(node(HERE / "read.mjs", "validate", tmp_path / "a.glb"))
    codes = {message["code"] for message in found["issues"]["messages"]}
    assert codes == {"UNSUPPORTED_EXTENSION", "MESH_PRIMITIVE_INVALID_ATTRIBUTE"}
    assert not found["issues"]["truncated"]
    assert found["info"]["totalVertexCount"] == 50


@pytest.mark.parametrize("degree", range(4))
def test_gltf_transform_reads_our_glb(tmp_path, degree) -> None:
    """Attributes have the names and encodings of KHR_gaussian_splatting."""
    needs_node("@gltf-transform/core")
    write_gaussians(tmp_path / "a.glb", sample(50, degree))
    found = json.loads(node(HERE / "read.mjs", "attributes", tmp_path / "a.glb"))
    assert found["MODE"] == 0, "points"

    def column(name: str, width: int) -> np.ndarray:
        return np.reshape(found[f"KHR_gaussian_splatting:{name}"], (50, width))

    opacity = column("OPACITY", 1)[:, 0]
    sh = [column(f"SH_DEGREE_{d}_COEF_{i}", 3) for d in range(degree + 1) for i in range(2 * d + 1)]
    decoded = gaussians_of(
        {
            "means": np.reshape(found["POSITION"], (50, 3)),
            "log_scales": np.log(column("SCALE", 3)),
            "quats": column("ROTATION", 4)[:, [3, 0, 1, 2]],
            "opacity_logits": np.log(opacity / (1 - opacity)),
            "dc": sh[0],
            "higher": np.concatenate([sh[0][:, :0], *sh[1:]], axis=1),
        }
    )
    # glTF is y up: rotated by 180 degrees about z.
    Within(1e-6, 2e-6, 2e-6, 0.05, 1e-6, 1e-6).check(half_turn(decoded), sample(50, degree))


@pytest.mark.parametrize(("suffix", "within"), [(".ply", EXACT), (".spz", SPZ)])
def test_gsply_reads_our_files(tmp_path, suffix, within) -> None:
    need_package("gsply", GSPLY)
    import gsply
    from gsply.spz import read_spz

    write_gaussians(tmp_path / f"a{suffix}", sample(300))
    read = gsply.plyread if suffix == ".ply" else read_spz
    found = read(str(tmp_path / f"a{suffix}"))
    decoded = gaussians_of(
        {
            "means": found.means,
            "log_scales": found.scales,
            "quats": found.quats,
            "opacity_logits": found.opacities,
            "dc": found.sh0,
            "higher": found.shN.reshape(300, -1),
        }
    )
    within.check(decoded, sample(300))
