"""PLY and GLB files, read back by their headers alone, and by Khronos's validator."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest

from pipeline.geometry.rotations import quat_to_rotation
from pipeline.surface.files import write_mesh_glb, write_mesh_ply
from pipeline.surface.mesh import Mesh
from pipeline.surface.texture import TexturedMesh
from tests.io.test_independent import HERE, needs_node, node


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


@pytest.fixture
def textured(mesh):
    ramp = np.linspace(20, 220, 24).astype(np.uint8)
    picture = np.dstack([np.tile(ramp, (16, 1)), np.full((16, 24), 100, np.uint8)] * 2)[..., :3]
    uv = np.random.default_rng(1).random((5, 2)).astype(np.float32)
    return TexturedMesh(mesh.vertices, mesh.faces, mesh.normals, uv, picture)


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
    """The JSON, the accessors' arrays and the binary chunk, with the container's own lengths
    checked."""
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
        kind = {5126: "<f4", 5125: "<u4"}[accessor["componentType"]]
        width = {"SCALAR": 1, "VEC2": 2, "VEC3": 3}[accessor["type"]]
        assert view["byteOffset"] % 4 == 0
        count = accessor["count"] * width
        array = np.frombuffer(rest[8:], kind, count, view["byteOffset"])
        assert array.nbytes == view["byteLength"]
        arrays.append(array.reshape(-1, width))
    return document, arrays, rest[8:]


def test_glb_holds_the_mesh_and_its_texture(tmp_path, textured):
    write_mesh_glb(tmp_path / "mesh.glb", textured, np.array([0.0, -1.0, 0.0]))
    document, arrays, body = read_glb((tmp_path / "mesh.glb").read_bytes())
    primitive = document["meshes"][0]["primitives"][0]
    names = primitive["attributes"]
    position, normal, uv = (arrays[names[n]] for n in ("POSITION", "NORMAL", "TEXCOORD_0"))
    assert np.array_equal(position, textured.vertices)
    assert np.array_equal(normal, textured.normals)
    assert np.array_equal(uv, textured.uv)
    assert np.array_equal(arrays[primitive["indices"]].reshape(-1, 3), textured.faces)
    box = document["accessors"][names["POSITION"]]
    assert np.array_equal(np.float32(box["min"]), position.min(axis=0))
    assert np.array_equal(np.float32(box["max"]), position.max(axis=0))
    view = document["bufferViews"][document["images"][0]["bufferView"]]
    data = body[view["byteOffset"] :][: view["byteLength"]]
    found = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    assert found.shape == textured.picture.shape
    assert np.abs(found.astype(int) - textured.picture).max() < 8


def test_khronos_validator_finds_nothing_in_a_mesh(tmp_path, textured):
    needs_node("gltf-validator")
    write_mesh_glb(tmp_path / "mesh.glb", textured, np.array([0.0, 0.0, 1.0]))
    found = json.loads(node(HERE / "read.mjs", "validate", tmp_path / "mesh.glb"))
    codes = {message["code"] for message in found["issues"]["messages"]}
    assert codes <= {"IMAGE_NPOT_DIMENSIONS"}, "glTF 2.0 allows any size"
    assert found["info"]["totalVertexCount"] == 5 and found["info"]["hasTextures"]


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
def test_glb_stands_upright(tmp_path, textured, up, forward):
    """The heading is that of Gaussians in a .glb file: forward is +z, also if up is about -y."""
    write_mesh_glb(tmp_path / "mesh.glb", textured, np.array(up, float))
    document, *_ = read_glb((tmp_path / "mesh.glb").read_bytes())
    x, y, z, w = document["nodes"][0]["rotation"]
    rotation = quat_to_rotation(np.array([w, x, y, z]))
    np.testing.assert_allclose(rotation @ up, (0, 1, 0), atol=2e-6)
    np.testing.assert_allclose(rotation @ forward, (0, 0, 1), atol=2e-3)
