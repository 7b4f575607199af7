"""Other programs read our files: Niantic's and Adobe's SPZ library, PlayCanvas's splat-transform,
gsply, Khronos's glTF validator, glTF Transform. `make test-packages` installs them; tests of
missing ones are skipped."""

from __future__ import annotations

import csv
import json
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.io.splat_files import read_gaussians, write_gaussians
from pipeline.io.spz import decode_spz, write_spz
from pipeline.splats.axes import LUF, RUB
from pipeline.splats.gaussians import Gaussians
from tests.io.test_sog import OURS as SOG
from tests.io.test_spz import OTHERS, axes_record, in_axes, with_extensions
from tests.io.test_spz import OURS as SPZ
from tests.splats.samples import EXACT, Within, sample
from tests.tools import need, need_package

HERE = Path(__file__).parent / "independent"
PACKAGES = json.loads((HERE / "package.json").read_text())["dependencies"]
GSPLY = "0.4.6"
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


def splat_transform(*arguments: str | Path) -> None:
    needs_node("@playcanvas/splat-transform")
    script = HERE / "node_modules/@playcanvas/splat-transform/bin/cli.mjs"
    node(script, "-w", "-q", *arguments)


def read_by_splat_transform(source: Path) -> Gaussians:
    """The Gaussians in the axes of PLY files."""
    table = source.with_suffix(".csv")
    splat_transform(source, table)
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


def read_by_niantic(*files: Path) -> list[tuple[Gaussians, dict[str, Any]]]:
    """The Gaussians of each file in the axes of PLY files, and all that the library found."""
    needs_node("@adobe/spz")
    read = []
    for found in json.loads(node(HERE / "read.mjs", "spz", *files)):
        columns = {
            "means": np.reshape(found["positions"], (-1, 3)),
            "log_scales": np.reshape(found["scales"], (-1, 3)),
            "quats": np.reshape(found["rotations"], (-1, 4))[:, [3, 0, 1, 2]],
            "opacity_logits": [np.inf if a is None else a for a in found["alphas"]],
            "dc": np.reshape(found["colors"], (-1, 3)),
            "higher": np.reshape(found["sh"], (len(found["alphas"]), -1)),
        }
        read.append((gaussians_of(columns), found))
    return read


@pytest.mark.parametrize("version", [3, 4])
def test_niantics_library_reads_our_spz(tmp_path, version) -> None:
    files = [tmp_path / f"{degree}.spz" for degree in range(4)]
    for degree, file in enumerate(files):
        write_spz(file, sample(300, degree), antialias=degree == 2, version=version)
    for degree, (gaussians, found) in enumerate(read_by_niantic(*files)):
        assert found["shDegree"] == degree and found["antialiased"] == (degree == 2)
        SPZ.check(gaussians, sample(300, degree))


def test_niantics_library_agrees_on_the_axes_that_a_file_names(tmp_path) -> None:
    files = {
        tmp_path / f"{version}-{code}.spz": with_extensions(version, axes_record(code))
        for version in (3, 4)
        for code in range(9)
    }
    for file, data in files.items():
        file.write_bytes(data)
    for (gaussians, _), data in zip(read_by_niantic(*files), files.values(), strict=True):
        replace(EXACT, opacity=0.004).check(gaussians, decode_spz(data))


FILES = {
    "a.ply": (3, EXACT),
    "a.spz": (3, SPZ),
    "b.spz": (4, SPZ),
    "a.sog": (3, SOG),
    "meta.json": (3, SOG),
    "a.splat": (3, SPLAT),
}


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("degree", [0, 3])
def test_splat_transform_reads_the_same_scene_from_our_files(tmp_path, name, degree) -> None:
    version, within = FILES[name]
    write_gaussians(tmp_path / name, sample(256, degree), spz_version=version)
    expected = sample(256, degree).with_sh_degree(0 if name == "a.splat" else degree)
    within.check(read_by_splat_transform(tmp_path / name), expected)


@pytest.mark.parametrize(
    ("name", "options", "within"),
    [
        ("b.spz", ["--spz-version", "3"], OTHERS),
        ("b.spz", [], OTHERS),
        ("b.ply", [], EXACT),
        ("b.glb", [], replace(EXACT, log_scale=2e-6, opacity=2e-6)),
    ],
)
def test_the_same_scene_is_read_from_files_of_splat_transform(
    tmp_path, name, options, within
) -> None:
    write_gaussians(tmp_path / "a.ply", sample(300))
    splat_transform(*options, tmp_path / "a.ply", tmp_path / name)
    within.check(read_gaussians(tmp_path / name, []), sample(300))


@pytest.mark.parametrize("degree", [0, 2])
def test_a_sog_file_of_splat_transform_is_read_as_it_reads_it(tmp_path, degree) -> None:
    """The file has another order, and a palette with fewer entries than Gaussians."""
    write_gaussians(tmp_path / "a.ply", sample(300, degree))
    splat_transform("-g", "cpu", tmp_path / "a.ply", tmp_path / "a.sog")
    within = replace(EXACT, position=2e-6, log_scale=2e-6)
    within.check(
        read_gaussians(tmp_path / "a.sog", []), read_by_splat_transform(tmp_path / "a.sog")
    )


@pytest.mark.parametrize("name", ["a.ply", "a.spz", "a.sog"])
def test_a_scene_is_upright_in_supersplat(tmp_path, name) -> None:
    """SuperSplat shows files in the space that splat-transform writes .glb files in: y up. The
    first Gaussian is below the others."""
    gaussians = sample(20, 0)
    gaussians.means[0, 1] = 50.0
    write_gaussians(tmp_path / name, gaussians)
    splat_transform(tmp_path / name, tmp_path / "seen.glb")
    heights = np.reshape(attributes(tmp_path / "seen.glb")["POSITION"], (-1, 3))[:, 1]
    assert heights.argmin() == 0 and heights[0] == pytest.approx(-50, abs=1e-3)


def attributes(file: Path) -> dict[str, Any]:
    """The attributes of the primitive of a .glb file, as glTF Transform reads them."""
    needs_node("@gltf-transform/core")
    return json.loads(node(HERE / "read.mjs", "attributes", file))


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
    write_gaussians(tmp_path / "a.glb", sample(50, degree))
    found = attributes(tmp_path / "a.glb")
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
    within = replace(EXACT, log_scale=2e-6, opacity=2e-6)
    within.check(in_axes(decoded, LUF), sample(50, degree))


@pytest.mark.parametrize("name", ["a.ply", "a.spz", "b.spz"])
def test_gsply_reads_our_files(tmp_path, name) -> None:
    """It does not convert the axes of SPZ files."""
    need_package("gsply", GSPLY)
    import gsply
    from gsply.spz import read_spz

    version, within = FILES[name]
    write_gaussians(tmp_path / name, sample(300), spz_version=version)
    is_spz = name.endswith(".spz")
    found = (read_spz if is_spz else gsply.plyread)(str(tmp_path / name))
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
    within.check(decoded, in_axes(sample(300), RUB if is_spz else (1, 1, 1)))
