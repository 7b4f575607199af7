""".glb files: round trips, the extension's layout and frame, and errors on malformed files."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pytest

from pipeline.io.gltf import read_gltf, write_gltf
from pipeline.io.ply import read_splat_ply
from pipeline.runtime.errors import UserError
from tests.splats.samples import EXACT, sample

DATA = Path(__file__).parent / "data"
NAME = "KHR_gaussian_splatting"


def parts(path: Path) -> tuple[dict, bytes]:
    """The JSON document and binary chunk, read independently of the code under test."""
    data = path.read_bytes()
    magic, version, size, length, kind = struct.unpack_from("<4sIII4s", data)
    assert (magic, version, size, kind) == (b"glTF", 2, len(data), b"JSON")
    assert length % 4 == 0
    rest, kind = struct.unpack_from("<I4s", data, 20 + length)
    assert kind == b"BIN\0" and 28 + length + rest == len(data)
    return json.loads(data[20 : 20 + length]), data[28 + length :]


def put_together(document: dict, body: bytes) -> bytes:
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(body))
    return (
        head + struct.pack("<I4s", len(text), b"JSON") + text
        + struct.pack("<I4s", len(body), b"BIN\0") + body
    )  # fmt: skip


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("count", [1, 300])
def test_round_trip_is_exact_up_to_logarithms(tmp_path, count, degree) -> None:
    gaussians = sample(count, degree)
    write_gltf(tmp_path / "a.glb", gaussians)
    EXACT.check(read_gltf(tmp_path / "a.glb"), gaussians)


def test_the_layout_is_that_of_the_extension(tmp_path) -> None:
    gaussians = sample(5)
    write_gltf(tmp_path / "a.glb", gaussians)
    document, body = parts(tmp_path / "a.glb")
    assert document["extensionsUsed"] == [NAME]
    (primitive,) = document["meshes"][0]["primitives"]
    assert primitive["mode"] == 0
    assert primitive["extensions"][NAME]["colorSpace"] == "srgb_rec709_display"
    names = {f"{NAME}:SH_DEGREE_{d}_COEF_{i}" for d in range(4) for i in range(2 * d + 1)}
    names |= {f"{NAME}:{name}" for name in ("ROTATION", "SCALE", "OPACITY")}
    assert set(primitive["attributes"]) == names | {"POSITION", "COLOR_0"}

    def column(name: str) -> np.ndarray:
        accessor = document["accessors"][primitive["attributes"][name]]
        view = document["bufferViews"][accessor["bufferView"]]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        return np.frombuffer(body, "<f4", 5 * width, view["byteOffset"]).reshape(5, width)

    # y up, front towards +z: the PLY's frame after half a turn about z.
    means = gaussians.means.numpy() * [-1, -1, 1]
    np.testing.assert_array_equal(column("POSITION"), means)
    assert document["accessors"][0]["min"] == means.min(0).tolist()
    np.testing.assert_allclose(column(f"{NAME}:SCALE"), gaussians.log_scales.exp(), rtol=1e-6)
    np.testing.assert_allclose(
        column(f"{NAME}:OPACITY")[:, 0], gaussians.opacity_logits.sigmoid(), atol=1e-6
    )
    np.testing.assert_allclose(
        np.linalg.norm(column(f"{NAME}:ROTATION"), axis=1), np.ones(5), atol=1e-6
    )
    # Degree 1 is y, z, x: two of them turn over.
    for k, sign in enumerate([-1, 1, -1]):
        np.testing.assert_array_equal(
            column(f"{NAME}:SH_DEGREE_1_COEF_{k}"), sign * gaussians.sh[:, 1 + k].numpy()
        )


def test_reads_what_splat_transform_wrote() -> None:
    """Positions, rotations and harmonics of the half turn agree with another program's."""
    EXACT.check(
        read_gltf(DATA / "splat-transform.glb"),
        read_splat_ply(DATA / "source.ply"),
    )


def test_quantised_and_interleaved_attributes_are_read(tmp_path) -> None:
    gaussians = sample(3, 0)
    write_gltf(tmp_path / "a.glb", gaussians)
    document, body = parts(tmp_path / "a.glb")
    attributes = document["meshes"][0]["primitives"][0]["attributes"]
    view = document["bufferViews"][attributes[f"{NAME}:ROTATION"]]
    floats = np.frombuffer(body, "<f4", 12, view["byteOffset"]).reshape(3, 4)
    shorts = np.rint(floats * 32767).astype("<i2")
    padded = np.concatenate([shorts, np.zeros((3, 2), "<i2")], 1).tobytes()
    document["bufferViews"].append(
        {"buffer": 0, "byteOffset": len(body), "byteLength": len(padded), "byteStride": 12}
    )
    document["accessors"][attributes[f"{NAME}:ROTATION"]] = {
        "bufferView": len(document["bufferViews"]) - 1,
        "componentType": 5122,
        "normalized": True,
        "count": 3,
        "type": "VEC4",
    }
    (tmp_path / "b.glb").write_bytes(put_together(document, body + padded))
    EXACT.check(read_gltf(tmp_path / "b.glb"), gaussians)


def test_writing_no_gaussians_is_an_error(tmp_path) -> None:
    with pytest.raises(UserError, match="1 to 17 million"):
        write_gltf(tmp_path / "a.glb", sample(0))
    assert not list(tmp_path.iterdir())


def _primitive(document: dict) -> dict:
    return document["meshes"][0]["primitives"][0]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d["nodes"][0].update(scale=[2, 2, 2]), "with a transform"),
        (lambda d: d["nodes"][0].update(matrix=[2.0] * 16), "with a transform"),
        (lambda d: _primitive(d).update(extensions={}), "found none"),
        (lambda d: _primitive(d)["attributes"].pop(f"{NAME}:SCALE"), "SCALE, found none"),
        (lambda d: _primitive(d)["attributes"].pop(f"{NAME}:SH_DEGREE_1_COEF_1"), "COEF_1"),
        (lambda d: _primitive(d)["attributes"].update(POSITION=99), "accessor 99"),
        (lambda d: _primitive(d)["attributes"].update(POSITION=-1), "accessor -1"),
        (lambda d: d["accessors"][0].update(count=10**12), "fewer"),
        (lambda d: d["accessors"][0].update(count=2), "one length"),
        (lambda d: d["accessors"][0].update(type="SCALAR"), "3 finite numbers"),
        (lambda d: d["accessors"][0].update(componentType=5125), "not known"),
        (lambda d: d["accessors"][0].update(bufferView=99), "buffer view 99"),
        (lambda d: d["accessors"][0].update(byteOffset=-4), "byteOffset"),
        (lambda d: d["accessors"][0].update(sparse={"count": 1}), "sparse"),
        (lambda d: d["bufferViews"][0].update(byteOffset=10**15), "fewer"),
        (lambda d: d["bufferViews"][0].update(buffer=1), "buffer"),
        (lambda d: d.update(meshes="none"), "meshes"),
        (lambda d: d["meshes"][0].update(primitives=d["meshes"][0]["primitives"] * 50), "share"),
    ],
)
def test_malformed_documents_are_an_error(tmp_path, change, message) -> None:
    path = tmp_path / "a.glb"
    write_gltf(path, sample(4, 1))
    document, body = parts(path)
    change(document)
    path.write_bytes(put_together(document, body))
    with pytest.raises(UserError, match=message) as caught:
        read_gltf(path)
    assert caught.value.file == path
