"""Binary glTF (.glb) with the extension KHR_gaussian_splatting: Gaussians as point primitives.

Programs without support for the extension show a coloured point cloud. glTF's axes are left, up,
forward: the world rotated by 180 degrees about z. Source: github.com/KhronosGroup/glTF,
KHR_gaussian_splatting, README.md.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from itertools import chain
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field, ValidationError

from pipeline.io.bounded import read_bounded
from pipeline.io.splat_codec import FIX, logit, sigmoid, to_uint8
from pipeline.runtime.atomic import write_pieces
from pipeline.runtime.errors import UserError
from pipeline.splats.arrays import Array, GaussianSource
from pipeline.splats.axes import LUF, Flipped, flip
from pipeline.splats.gaussians import Gaussians, concat
from pipeline.splats.init import SH_C0

GAUSSIAN_SPLATTING = "KHR_gaussian_splatting"
_HEADER, _CHUNK = struct.Struct("<4sII"), struct.Struct("<I4s")
_TYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
_COEFFICIENTS = tuple(f"SH_DEGREE_{d}_COEF_{i}" for d in range(4) for i in range(2 * d + 1))
_FIX = "write the file again as .glb without compression and without node transforms, or use a PLY"
# Lower bound on the bytes of a Gaussian: float32 position and colour, 8 bits for other values.
_LEAST_BYTES = 32
# Opacities are clamped this far from 0 and 1, whose logits are infinite.
_OPACITY_MARGIN = 1e-6


def write_gltf(path: Path, gaussians: GaussianSource) -> None:
    """Write a .glb file atomically.

    Raises:
        UserError: There are no Gaussians, or more than the format's limit of 4 GiB.
    """
    count = len(gaussians)
    if not 0 < count * (192 + 48) < 2**32 - 2**20:
        raise UserError(
            f"a .glb file can hold 1 to 17 million Gaussians, found {count}",
            file=path,
            fix="change experiments.export.min_opacity, which leaves out faint Gaussians",
        )
    gaussians = Flipped(gaussians, LUF)
    columns = _columns(gaussians.sh_degree)
    accessors: list[dict[str, Any]] = []
    for column in columns:
        accessors.append(
            {
                "bufferView": len(accessors),
                "componentType": 5121 if column.is_bytes else 5126,
                "count": count,
                "type": {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[column.width],
            }
        )
        if column.is_bytes:
            accessors[-1]["normalized"] = True
    bounds = [np.stack([means.min(0), means.max(0)]) for (means,) in gaussians.chunks("means")]
    low, high = np.min(bounds, 0)[0], np.max(bounds, 0)[1]
    accessors[0] |= {"min": low.tolist(), "max": high.tolist()}
    sizes = [count * column.width * (1 if column.is_bytes else 4) for column in columns]
    starts = np.cumsum([0, *sizes]).tolist()
    primitive = {
        "attributes": {column.name: i for i, column in enumerate(columns)},
        "mode": 0,
        "extensions": {GAUSSIAN_SPLATTING: splat_rendering()},
    }
    document = {
        "asset": {"version": "2.0", "generator": "splatmake"},
        "extensionsUsed": [GAUSSIAN_SPLATTING],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": [
            {"buffer": 0, "byteOffset": start, "byteLength": length, "target": 34962}
            for start, length in zip(starts, sizes, strict=False)
        ],
        "buffers": [{"byteLength": starts[-1]}],
    }
    body = (
        np.asarray(column.values(*chunk), "u1" if column.is_bytes else "<f4").tobytes()
        for column in columns
        for chunk in gaussians.chunks(*column.arrays)
    )
    write_pieces(path, chain([_head(document, starts[-1])], body))


def splat_rendering() -> dict[str, Any]:
    """The properties of the extension: how the Gaussians were rendered in training."""
    return {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }


def glb(document: dict[str, Any], body: bytes) -> bytes:
    """A .glb file of a document and its buffer."""
    padding = b"\0" * (-len(body) % 4)
    return _head(document, len(body) + len(padding)) + body + padding


def _head(document: dict[str, Any], body: int) -> bytes:
    """A .glb file before the ``body`` bytes of its buffer, a multiple of 4."""
    text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    size = _HEADER.size + 2 * _CHUNK.size + len(text) + body
    start = _HEADER.pack(b"glTF", 2, size) + _CHUNK.pack(len(text), b"JSON") + text
    return start + _CHUNK.pack(body, b"BIN\0")


class _Column(NamedTuple):
    """An attribute of the primitive: its width, and its values from chunks of arrays."""

    name: str
    width: int
    arrays: tuple[str, ...]
    values: Callable[..., NDArray[Any]]
    is_bytes: bool = False


def _columns(sh_degree: int) -> list[_Column]:
    """The attributes of Gaussians in glTF's axes."""

    def colour(sh: Array, logits: Array) -> NDArray[np.uint8]:
        return to_uint8(np.concatenate([0.5 + SH_C0 * sh[:, 0], sigmoid(logits)[:, None]], 1) * 255)

    def rotation(quats: Array) -> NDArray[Any]:
        norm = np.linalg.norm(quats, axis=1, keepdims=True)
        unit = np.where(norm > 0, quats / np.maximum(norm, 1e-30), (1, 0, 0, 0))
        return unit[:, [1, 2, 3, 0]]

    def coefficient(k: int) -> Callable[[Array], Array]:
        return lambda sh: sh[:, k]

    return [
        _Column("POSITION", 3, ("means",), lambda means: means),
        _Column("COLOR_0", 4, ("sh", "opacity_logits"), colour, is_bytes=True),
        _Column(f"{GAUSSIAN_SPLATTING}:ROTATION", 4, ("quats",), rotation),
        _Column(f"{GAUSSIAN_SPLATTING}:SCALE", 3, ("log_scales",), np.exp),
        _Column(
            f"{GAUSSIAN_SPLATTING}:OPACITY", 1, ("opacity_logits",), lambda x: sigmoid(x)[:, None]
        ),
        *(
            _Column(f"{GAUSSIAN_SPLATTING}:{name}", 3, ("sh",), coefficient(k))
            for k, name in enumerate(_COEFFICIENTS[: (sh_degree + 1) ** 2])
        ),
    ]


def read_gltf(path: Path) -> Gaussians:
    """Read the Gaussians of all primitives of a .glb file, in the world's axes.

    Raises:
        UserError: the file is missing, truncated or malformed, has no Gaussians, or has
            compressed Gaussians or nodes with transforms.
    """
    data = read_bounded(path, fix=FIX)
    try:
        text, body = _chunks(data)
        document = _Document.model_validate_json(text)
        if any(node.has_transform for node in document.nodes):
            raise ValueError("expected nodes without transforms, found one with a transform")
        primitives = [p for mesh in document.meshes for p in mesh.primitives if p.is_splats]
        if not primitives:
            raise ValueError(f"expected Gaussians ({GAUSSIAN_SPLATTING}), found none")
        parts: list[Gaussians] = []
        for primitive in primitives:
            parts.append(_gaussians(document, body, primitive.attributes))
            # With shared accessors, a small file could expand to any number of Gaussians.
            if sum(map(len, parts)) * _LEAST_BYTES > len(body):
                raise ValueError("expected each Gaussian once, found primitives that share data")
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        what = f"expected glTF, found {where or 'text'}: {first['msg']}"[:300]
        raise UserError(what, file=path, fix=_FIX) from None
    except ValueError as error:
        raise UserError(str(error), file=path, fix=_FIX) from None
    degree = max(part.sh_degree for part in parts)
    return concat([part.with_sh_degree(degree) for part in parts])


class _View(BaseModel):
    buffer: Literal[0]
    byteOffset: int = Field(0, ge=0)
    byteLength: int = Field(ge=0)
    byteStride: int | None = Field(None, ge=4, le=252)


class _Accessor(BaseModel):
    bufferView: int = Field(ge=0)
    byteOffset: int = Field(0, ge=0)
    componentType: int
    count: int = Field(ge=1)
    type: str
    normalized: bool = False
    sparse: None = None


class _Node(BaseModel):
    matrix: list[float] | None = None
    translation: list[float] = [0, 0, 0]
    rotation: list[float] = [0, 0, 0, 1]
    scale: list[float] = [1, 1, 1]

    @property
    def has_transform(self) -> bool:
        return (
            self.rotation[:3] != [0, 0, 0]
            or self.translation != [0, 0, 0]
            or self.scale != [1, 1, 1]
            or self.matrix not in (None, np.eye(4).ravel().tolist())
        )


class _Primitive(BaseModel):
    attributes: dict[str, int]
    extensions: dict[str, Any] = {}

    @property
    def is_splats(self) -> bool:
        return GAUSSIAN_SPLATTING in self.extensions


class _Mesh(BaseModel):
    primitives: list[_Primitive]


class _Document(BaseModel):
    """The parts of a glTF document that Gaussians depend on."""

    nodes: list[_Node] = []
    meshes: list[_Mesh] = []
    accessors: list[_Accessor] = []
    bufferViews: list[_View] = []


def _chunks(data: bytes) -> tuple[bytes, memoryview]:
    """The JSON text and the binary chunk."""
    if len(data) < _HEADER.size or data[:4] != b"glTF":
        raise ValueError("expected a .glb file, found something else")
    _, version, size = _HEADER.unpack_from(data)
    if version != 2 or size != len(data):
        raise ValueError(f"expected glTF 2 of {size} bytes, found {version} of {len(data)} bytes")
    chunks: dict[bytes, memoryview] = {}
    at = _HEADER.size
    while at + _CHUNK.size <= size:
        length, kind = _CHUNK.unpack_from(data, at)
        at += _CHUNK.size
        if at + length > size:
            raise ValueError(f"expected a chunk of {length} bytes, found {size - at}")
        chunks.setdefault(kind, memoryview(data)[at : at + length])
        at += length
    if b"JSON" not in chunks:
        raise ValueError("expected a chunk of JSON, found none")
    return bytes(chunks[b"JSON"]), chunks.get(b"BIN\0", memoryview(b""))


def _gaussians(document: _Document, body: memoryview, attributes: dict[str, int]) -> Gaussians:
    def column(name: str, width: int) -> NDArray[np.float32]:
        if name not in attributes:
            raise ValueError(f"expected the attribute {name}, found none (compressed?)")
        values = _values(document, body, attributes[name])
        if values.shape != (len(values), width) or not np.isfinite(values).all():
            raise ValueError(f"{name}: expected {width} finite numbers for each Gaussian")
        return values

    degree = max(
        (d for d in range(4) if f"{GAUSSIAN_SPLATTING}:SH_DEGREE_{d}_COEF_0" in attributes),
        default=0,
    )
    names = _COEFFICIENTS[: (degree + 1) ** 2]
    scale = column(f"{GAUSSIAN_SPLATTING}:SCALE", 3)
    if scale.min() < 0:
        log_scales = scale  # Drafts of the extension stored logarithms.
    else:
        with np.errstate(divide="ignore"):
            log_scales = np.log(scale)
    arrays: dict[str, NDArray[Any]] = {
        "means": column("POSITION", 3),
        "log_scales": log_scales,
        "quats": column(f"{GAUSSIAN_SPLATTING}:ROTATION", 4)[:, [3, 0, 1, 2]],
        "opacity_logits": logit(column(f"{GAUSSIAN_SPLATTING}:OPACITY", 1)[:, 0], _OPACITY_MARGIN),
    }
    coefficients = [column(f"{GAUSSIAN_SPLATTING}:{name}", 3) for name in names]
    if any(len(values) != len(scale) for values in (*arrays.values(), *coefficients)):
        raise ValueError("expected attributes of one length, found several")
    return Gaussians.from_arrays(flip(arrays | {"sh": np.stack(coefficients, 1)}, LUF))


def _values(document: _Document, body: memoryview, index: int) -> NDArray[np.float32]:
    """(count, width) values of an accessor; integers are normalised if it is ``normalized``."""
    if not 0 <= index < len(document.accessors):
        raise ValueError(f"expected accessor {index}, found none")
    accessor = document.accessors[index]
    if accessor.bufferView >= len(document.bufferViews):
        raise ValueError(f"expected buffer view {accessor.bufferView}, found none")
    view = document.bufferViews[accessor.bufferView]
    if accessor.componentType not in _TYPES or accessor.type not in _WIDTHS:
        raise ValueError(f"accessor {index}: {accessor.componentType} {accessor.type} is not known")
    dtype, width = np.dtype(_TYPES[accessor.componentType]), _WIDTHS[accessor.type]
    row = dtype.itemsize * width
    stride = view.byteStride or row
    inside = accessor.byteOffset + (accessor.count - 1) * stride + row
    if inside > view.byteLength or view.byteOffset + view.byteLength > len(body):
        raise ValueError(f"accessor {index}: expected {inside} bytes, found fewer")
    table: NDArray[Any] = np.ndarray(
        (accessor.count, width),
        dtype,
        body,
        view.byteOffset + accessor.byteOffset,
        (stride, dtype.itemsize),
    )
    if accessor.normalized and dtype.kind != "f":
        return np.maximum(table / np.float32(np.iinfo(dtype).max), -1).astype(np.float32)
    return table.astype(np.float32)
