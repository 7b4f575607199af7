"""Mesh files: PLY and binary glTF 2.0 (.glb)."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.runtime.atomic import write_bytes
from pipeline.surface.mesh import Mesh
from pipeline.surface.texture import TexturedMesh

_FLOAT, _UINT = 5126, 5125  # component types of glTF
_ARRAY, _ELEMENT = 34962, 34963  # buffer targets of glTF
_LINEAR, _CLAMP = 9729, 33071  # filter and wrapping of glTF
_QUALITY = 95  # of JPEG textures


def write_mesh_ply(path: Path, mesh: Mesh) -> None:
    """Binary little-endian: float positions and normals, uchar red, green, blue (sRGB); faces as
    lists of three ints."""
    vertex = np.zeros(
        len(mesh.vertices),
        [("xyz", "<f4", 3), ("normal", "<f4", 3), ("rgb", "u1", 3)],
    )
    vertex["xyz"], vertex["normal"], vertex["rgb"] = mesh.vertices, mesh.normals, mesh.colors
    face = np.zeros(len(mesh.faces), [("count", "u1"), ("corner", "<i4", 3)])
    face["count"], face["corner"] = 3, mesh.faces
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(vertex)}",
        *(f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")),
        *(f"property uchar {name}" for name in ("red", "green", "blue")),
        f"element face {len(face)}",
        "property list uchar int vertex_indices",
        "end_header",
        "",
    ]
    write_bytes(path, "\n".join(header).encode() + vertex.tobytes() + face.tobytes())


def write_mesh_glb(path: Path, mesh: TexturedMesh, up: NDArray[np.float64]) -> None:
    """Binary glTF 2.0: positions in the world's frame, normals, TEXCOORD_0, the texture as JPEG,
    unlit (the colours include the lighting).

    Args:
        up: (3,) up vector of the world; the node's rotation takes it to glTF's, +y.
    """
    arrays = [
        (mesh.vertices.astype("<f4"), _FLOAT, "VEC3", _ARRAY),
        (mesh.normals.astype("<f4"), _FLOAT, "VEC3", _ARRAY),
        (mesh.uv.astype("<f4"), _FLOAT, "VEC2", _ARRAY),
        (mesh.faces.astype("<u4").reshape(-1), _UINT, "SCALAR", _ELEMENT),
    ]
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []
    offset = 0
    for i, (array, kind, shape, target) in enumerate(arrays):
        size = array.nbytes  # A multiple of 4 bytes, so that all views are aligned.
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": size, "target": target})
        accessors.append(
            {"bufferView": i, "componentType": kind, "count": len(array), "type": shape}
        )
        offset += size
    accessors[0] |= {
        "min": mesh.vertices.min(axis=0).astype(float).tolist(),
        "max": mesh.vertices.max(axis=0).astype(float).tolist(),
    }
    picture = _jpeg(mesh.picture)
    views.append({"buffer": 0, "byteOffset": offset, "byteLength": len(picture)})
    body = b"".join(array.tobytes() for array, *_ in arrays) + picture
    body += b"\0" * (-len(body) % 4)
    primitive = {
        "attributes": {"POSITION": 0, "NORMAL": 1, "TEXCOORD_0": 2},
        "indices": 3,
        "material": 0,
    }
    document = {
        "asset": {"version": "2.0", "generator": "splatmake"},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "rotation": _rotation_to_y_up(up)}],
        "meshes": [{"primitives": [primitive]}],
        "materials": [
            {
                "extensions": {"KHR_materials_unlit": {}},
                "pbrMetallicRoughness": {
                    "baseColorTexture": {"index": 0},
                    "metallicFactor": 0.0,
                    "roughnessFactor": 1.0,
                },
                "doubleSided": True,
            }
        ],
        "textures": [{"source": 0, "sampler": 0}],
        "images": [{"bufferView": len(arrays), "mimeType": "image/jpeg"}],
        # Without mipmaps, which would mix charts; edges are clamped.
        "samplers": [
            {"magFilter": _LINEAR, "minFilter": _LINEAR, "wrapS": _CLAMP, "wrapT": _CLAMP}
        ],
        "buffers": [{"byteLength": len(body)}],
        "bufferViews": views,
        "accessors": accessors,
    }
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    chunks = [(b"JSON", text), (b"BIN\0", body)]
    total = 12 + sum(8 + len(data) for _, data in chunks)
    out = [b"glTF", np.array([2, total], "<u4").tobytes()]
    for name, data in chunks:
        out += [np.array([len(data)], "<u4").tobytes(), name, data]
    write_bytes(path, b"".join(out))


def _jpeg(picture: NDArray[np.uint8]) -> bytes:
    """The (H, W, 3) picture, with chroma at full resolution."""
    options = [cv2.IMWRITE_JPEG_QUALITY, _QUALITY]
    options += [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    _, data = cv2.imencode(".jpg", np.ascontiguousarray(picture[..., ::-1]), options)
    return data.tobytes()


def _rotation_to_y_up(up: NDArray[np.float64]) -> list[float]:
    """Quaternion xyzw of half a turn about z, to the axes of ``io.gltf``, followed by the smallest
    rotation that then takes the unit vector ``up`` to +y."""
    quaternion = np.array([0.0, up[2], 1 - up[1], up[0]])
    norm = float(np.linalg.norm(quaternion))
    return (quaternion / norm).tolist() if norm > 1e-9 else [0.0, 0.0, 0.0, 1.0]
