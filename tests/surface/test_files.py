"""PLY and GLB files, read back by their headers alone."""

from __future__ import annotations

import json

import numpy as np
import pytest

from pipeline.geometry.rotations import quat_to_rotation
from pipeline.surface.files import write_mesh_glb, write_mesh_ply
from pipeline.surface.mesh import Mesh


@pytest.fixture
def mesh():
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(5, 3))
    return Mesh(
        rng.normal(size=(5, 3)).astype(np.float32),
        np.array([[0, 1, 2], [2, 1, 3], [3, 4, 0]], np.int32),
        (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32),
        np.array([[0, 0, 0], [255, 255, 255], [128, 64, 32], [1, 2, 3], [9, 200, 77]], np.uint8),
    )


def test_ply_header_describes_the_data(tmp_path, mesh):
    write_mesh_ply(tmp_path / "mesh.ply", mesh)
    header, body = (tmp_path / "mesh.ply").read_bytes().split(b"end_header\n", 1)
    lines = header.decode().splitlines()
    assert lines[:3] == ["ply", "format binary_little_endian 1.0", "element vertex 5"]
    assert lines[-2:] == ["element face 3", "property list uchar int vertex_indices"]
    kinds = {"float": "<f4", "uchar": "u1"}
    fields = [(p[2], kinds[p[1]]) for p in (line.split() for line in lines[3:-2])]
    vertex = np.frombuffer(body, np.dtype(fields), 5)
    assert np.array_equal(vertex["y"], mesh.vertices[:, 1])
    assert np.array_equal(vertex["nz"], mesh.normals[:, 2])
    assert np.array_equal(vertex["blue"], mesh.colors[:, 2])
    face = np.frombuffer(body[vertex.nbytes :], [("n", "u1"), ("at", "<i4", 3)])
    assert (face["n"] == 3).all()
    assert np.array_equal(face["at"], mesh.faces)


def read_glb(data: bytes):
    """The JSON and the accessors' arrays, with the container's own lengths checked."""
    assert data[:4] == b"glTF"
    version, total, size = np.frombuffer(data, "<u4", 3, 4)
    assert (version, total) == (2, len(data))
    assert data[16:20] == b"JSON" and size % 4 == 0
    document = json.loads(data[20 : 20 + size])
    rest = data[20 + size :]
    assert (
        int(np.frombuffer(rest, "<u4", 1)[0])
        == len(rest) - 8
        == document["buffers"][0]["byteLength"]
    )
    assert rest[4:8] == b"BIN\0"
    arrays = []
    for accessor in document["accessors"]:
        view = document["bufferViews"][accessor["bufferView"]]
        kind = {5126: "<f4", 5123: "<u2", 5125: "<u4"}[accessor["componentType"]]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        assert view["byteOffset"] % 4 == 0
        count = accessor["count"] * width
        array = np.frombuffer(rest[8:], kind, count, view["byteOffset"])
        assert array.nbytes == view["byteLength"]
        arrays.append(array.reshape(-1, width))
    return document, arrays


def test_glb_holds_the_mesh_in_gltfs_units(tmp_path, mesh):
    write_mesh_glb(tmp_path / "mesh.glb", mesh, np.array([0.0, -1.0, 0.0]))
    document, arrays = read_glb((tmp_path / "mesh.glb").read_bytes())
    primitive = document["meshes"][0]["primitives"][0]
    names = primitive["attributes"]
    position, normal, color = (arrays[names[n]] for n in ("POSITION", "NORMAL", "COLOR_0"))
    assert np.array_equal(position, mesh.vertices)
    assert np.array_equal(normal, mesh.normals)
    assert np.array_equal(arrays[primitive["indices"]].reshape(-1, 3), mesh.faces)
    box = document["accessors"][names["POSITION"]]
    assert np.array_equal(np.float32(box["min"]), position.min(axis=0))
    assert np.array_equal(np.float32(box["max"]), position.max(axis=0))
    # COLOR_0 is linear light: sRGB's middle grey 128 is 0.2159 of it.
    assert (color[:, 3] == 65535).all() and color[1, 0] == 65535 and color[0, 0] == 0
    assert abs(color[2, 0] / 65535 - 0.21586) < 1e-4


@pytest.mark.parametrize(
    ("up", "forward"),
    [
        ((0, -1, 0), (0, 0, 1)),
        ((0, -0.999999, 0.001414), (0, 0, 1)),
        ((0, 1, 0), (0, 0, 1)),
        ((0, 0, 1), (0, 1, 0)),
        ((0.6, 0.0, -0.8), (0.48, -0.8, 0.36)),
    ],
)
def test_glb_stands_upright(tmp_path, mesh, up, forward):
    """The heading is that of Gaussians in a .glb file: forward is +z, also if up is about -y."""
    write_mesh_glb(tmp_path / "mesh.glb", mesh, np.array(up, float))
    document, _ = read_glb((tmp_path / "mesh.glb").read_bytes())
    x, y, z, w = document["nodes"][0]["rotation"]
    rotation = quat_to_rotation(np.array([w, x, y, z]))
    np.testing.assert_allclose(rotation @ up, (0, 1, 0), atol=2e-6)
    np.testing.assert_allclose(rotation @ forward, (0, 0, 1), atol=2e-3)
