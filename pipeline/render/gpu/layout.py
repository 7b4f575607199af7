"""How data lies in buffers; the structs and sections of the WGSL files."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pipeline.render.gpu.device import Buffer, Gpu
from pipeline.render.types import RasterCamera, RasterOptions

Tensors = dict[str, Tensor]

TILE = 16  # kTile in constants.h
RECORD_BYTES = 48  # Record in record.wgsl
SLOT_BYTES = 40  # kMoments floats in moments.wgsl
CAMERA_PARAMETERS = 10  # kCameraParameters in gradient.wgsl
ANTIALIAS, CLAMP_COLOR_GRADIENT = 1, 2  # flags of View
BYTES, MASKED = 1, 2  # flags of Loss in loss.wgsl
FRONT, CORRECTION = 1, 2  # flags of Layers in compose.wgsl
SH_ADAM, CAMERA = 1, 2  # flags of Adam in project_backward.wgsl
PLANES = 1  # flag of Band in band.wgsl
FRAMES, COLORS = 1, 4  # flags of Options in update_gaussians.wgsl, beside CAMERA

# The sections of arrays: names and the number of floats of a Gaussian. geometry.wgsl has the
# offsets of the parameters, project_backward.wgsl those of the gradients.
GEOMETRY = {"means": 3, "log_scales": 3, "quats": 4, "opacity_logits": 1}
STATISTICS = {"gradient_sum": 1, "seen": 1}
GRADIENTS = GEOMETRY | {"means2d": 2, "colors": 3}
# The parameters whose moments are in one array, first and second of each, as update_gaussians.wgsl
# reads them.
MOMENTS = ("log_scales", "opacity_logits", "means", "quats")


def written_gradients(*, camera: bool, colors: bool, frames: bool) -> dict[str, int]:
    """The sections of the gradients that a training step writes for other kernels.

    Args:
        camera, colors: Whether these are read.
        frames: Whether means and rotations are updated in the local frames, not by their gradients.
    """
    found = {"camera": CAMERA_PARAMETERS} if camera else {}
    found |= {"colors": GRADIENTS["colors"]} if colors else {}
    return found if frames else found | {name: GEOMETRY[name] for name in ("means", "quats")}


def moments(first: Mapping[str, Tensor], second: Mapping[str, Tensor]) -> Tensors:
    """The tensors of the array of moments, by the names of its sections, in order."""
    found: Tensors = {}
    for name in MOMENTS:
        found |= {f"first {name}": first[name], f"second {name}": second[name]}
    return found


def words(tensors: Mapping[str, Tensor]) -> dict[str, int]:
    """The sections of an array of tensors (N, ...) of any type, in words, as of ``join``."""
    return {
        name: -(-math.prod(tensor.shape[1:]) * tensor.element_size() // 4)
        for name, tensor in tensors.items()
    }


def floats(sections: Mapping[str, int]) -> int:
    """The number of floats of one Gaussian."""
    return sum(sections.values())


def offsets(sections: Mapping[str, int], count: int) -> dict[str, tuple[int, int]]:
    """The first float and the number of floats of each section of ``count`` rows."""
    found, at = {}, 0
    for name, width in sections.items():
        found[name] = at, width * count
        at += width * count
    return found


def join(tensors: Iterable[Tensor]) -> NDArray[Any]:
    """The numbers of tensors of one type, one tensor after another; see ``_numbers``."""
    return np.concatenate([_numbers(tensor.detach()).reshape(-1) for tensor in tensors])


def _numbers(tensor: Tensor) -> NDArray[Any]:
    """The numbers of a tensor as they lie in a buffer. Rows of bfloat16 are padded to whole words,
    so that no two threads write to one."""
    if tensor.dtype != torch.bfloat16:
        return tensor.numpy()
    rows = tensor.flatten(1).view(torch.uint16).numpy()
    return np.pad(rows, ((0, 0), (0, rows.shape[1] % 2)))


def split(sections: Mapping[str, int], whole: Buffer, gpu: Gpu, count: int) -> Tensors:
    """The tensors (N, width) of the sections of a buffer."""
    numbers = torch.from_numpy(gpu.read(whole, np.float32, floats(sections) * count))
    return {
        name: numbers[at : at + size].view(count, sections[name])
        for name, (at, size) in offsets(sections, count).items()
    }


def fetch(gpu: Gpu, buffer: Buffer, *tensors: Tensor) -> None:
    """Copy a buffer into tensors of one type, which lie in it as of ``join``."""
    shapes = [_numbers(tensor.detach()) for tensor in tensors]
    found = gpu.read(buffer, shapes[0].dtype, sum(each.size for each in shapes))
    at = 0
    for tensor, like in zip(tensors, shapes, strict=True):
        rows = torch.from_numpy(found[at : at + like.size].reshape(like.shape))
        if tensor.dtype == torch.bfloat16:
            rows = rows[:, : tensor[:1].numel()].contiguous().view(torch.bfloat16)
        tensor.detach().copy_(rows.reshape(tensor.shape))
        at += like.size


def tiles_of(width: int, height: int) -> tuple[int, int]:
    """The number of tiles across and down an image."""
    return -(-width // TILE), -(-height // TILE)


def pack_view(
    camera: RasterCamera, options: RasterOptions, count: int, coefficients: int
) -> NDArray[np.uint8]:
    """The bytes of ``View`` in view.wgsl, of ``count`` Gaussians with ``coefficients`` SH
    coefficients each."""
    pose = camera.world_to_camera.detach().double().numpy()
    rotation, centre = pose[:3, :3], -pose[:3, :3].T @ pose[:3, 3]
    min_u, max_u, min_v, max_v = camera.slopes
    flags = ANTIALIAS * options.antialias + CLAMP_COLOR_GRADIENT * options.clamp_color_gradient
    packed = struct.pack(
        "<8I8f 3ff 3fI 3fI 3fI 3fI",
        camera.width, camera.height, *tiles_of(camera.width, camera.height),
        count, coefficients, options.sh_degree, flags,
        camera.fx, camera.fy, camera.cx, camera.cy, min_u, min_v, max_u, max_v,
        *rotation[0], options.near, *rotation[1], 0,
        *rotation[2], 0, *centre, 0, *(options.background or (0.0, 0.0, 0.0)), 0,
    )  # fmt: skip
    return np.frombuffer(packed, np.uint8)
