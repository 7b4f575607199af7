"""The kernels of a rendered view and of its gradients, in order."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from pipeline.render.gpu import layout
from pipeline.render.gpu.adam import uniform
from pipeline.render.gpu.device import Buffer, Gpu, blocks
from pipeline.render.gpu.primitives import scan, sort, sum_rows
from pipeline.render.gpu.workspace import Workspace
from pipeline.render.types import AdamRates, CameraGradients
from pipeline.runtime.errors import UserError

# Slots of gradients are the largest array: more pairs do not fit into 4 GB, WebGPU's offsets.
MAX_INTERSECTIONS = (1 << 32) // layout.SLOT_BYTES - 1
DEPTH_BITS = 32
NO_RATES = AdamRates((0.0, 0.0), 1)
# The tiles of one dispatch: an image of 1024 x 1024 pixels.
TILES_OF_BAND = 4096


@dataclass(frozen=True)
class Scene:
    """The parameters of ``count`` Gaussians on the device.

    Attributes:
        coefficients: K, the number of SH coefficients of each color channel.
        geometry: The sections ``layout.GEOMETRY``.
        sh: (N, K, 3).
    """

    count: int
    coefficients: int
    geometry: Buffer
    sh: Buffer


@dataclass(frozen=True)
class Projection:
    """The Gaussians on the image plane; arrays of N.

    Attributes:
        scene: The projected Gaussians.
        view: ``View``.
        size: The width and height of the image.
        records, boxes: ``Record`` and ``Box`` of the visible Gaussians.
        radii: See ``Forward.radii``.
        tile_counts: The number of tiles of each Gaussian.
        visible: 1 for visible Gaussians, 0 for others.
        dropped: See ``Forward.num_dropped``.
    """

    scene: Scene
    view: Buffer
    size: tuple[int, int]
    records: Buffer
    boxes: Buffer
    radii: Buffer
    tile_counts: Buffer
    visible: Buffer
    dropped: Buffer


@dataclass(frozen=True)
class Lists:
    """The (Gaussian, tile) pairs. Pairs are numbered by depth of their Gaussian.

    Attributes:
        num_visible, num_dropped: See ``Forward``.
        length: The number of pairs.
        gaussian_of: The Gaussian of each pair.
        pairs: The pairs, by tile and front to back.
        ranges: The range of each tile in ``pairs``.
        slots: The first pair of each Gaussian.
    """

    projection: Projection
    num_visible: int
    num_dropped: int
    length: int
    gaussian_of: Buffer
    pairs: Buffer
    ranges: Buffer
    slots: Buffer

    @property
    def by_tile(self) -> dict[str, Buffer]:
        """The buffers of the kernels of tiles: the Gaussians of each tile, front to back."""
        return {
            "view": self.projection.view,
            "records": self.projection.records,
            "gaussian_of": self.gaussian_of,
            "pairs": self.pairs,
            "ranges": self.ranges,
        }


@dataclass(frozen=True)
class Image:
    """A rendered view.

    Attributes:
        color: (H, W, 3).
        planes: (3, H, W), alpha, depth and median depth.
        ends: (H, W), see blend.wgsl.
    """

    lists: Lists
    color: Buffer
    planes: Buffer
    ends: Buffer

    def plane(self, gpu: Gpu, number: int) -> Tensor:
        """(H, W), a copy of one of the planes."""
        width, height = self.lists.projection.size
        pixels = width * height
        found = gpu.read(self.planes, np.float32, pixels, 4 * pixels * number)
        return torch.from_numpy(found).view(height, width)


def project(space: Workspace, scene: Scene, view: Buffer, size: tuple[int, int]) -> Projection:
    """Project all Gaussians."""
    count = scene.count
    arrays = {
        "records": space.get("records", layout.RECORD_BYTES * count),
        "boxes": space.get("boxes", layout.BOX_BYTES * count),
        "radii": space.get("radii", 4 * count),
        "tile_counts": space.get("tile counts", 4 * count),
        "visible": space.get("visible", 4 * count),
        "dropped": space.get("dropped", 4),
    }
    space.gpu.clear(arrays["dropped"])
    space.run("project", blocks(count), view=view, geometry=scene.geometry, sh=scene.sh, **arrays)
    return Projection(scene, view, size, **arrays)


def list_pairs(space: Workspace, projection: Projection) -> Lists:
    """List the Gaussians that overlap each tile, front to back.

    Raises:
        UserError: There are too many pairs.
    """
    gpu, p, count = space.gpu, projection, projection.scene.count
    tiles_x, tiles_y = layout.tiles_of(*p.size)
    tiles = tiles_x * tiles_y
    ranges = space.get("tile ranges", 8 * tiles)
    gpu.clear(ranges)
    slots = space.get("slots of Gaussians", 4 * count)
    ordered, num_visible = _visible_by_depth(space, p)
    # One more than the Gaussians: the last prefix sum is the number of pairs.
    first = space.get("first pairs", 4 * (count + 1))
    space.run(
        "order",
        blocks(count + 1),
        size=gpu.uniform("I", count + 1),
        length=num_visible,
        gaussians=ordered,
        tile_counts=p.tile_counts,
        ordered=first,
    )
    scan(space, first, count + 1)
    totals = space.get("totals", 12)
    gpu.copy(num_visible, 0, totals, 0, 4)
    gpu.copy(p.dropped, 0, totals, 4, 4)
    gpu.copy(first, 4 * count, totals, 8, 4)
    seen, dropped, length = map(int, gpu.read(totals, np.uint32, 3))
    if length > MAX_INTERSECTIONS:
        raise UserError(
            f"{seen} Gaussians overlap more than {MAX_INTERSECTIONS} tiles of 16 x 16 pixels in "
            "one view",
            fix="render smaller images, or remove Gaussians that are far too large",
        )
    tile_of, numbers = space.get("tiles of pairs", 4 * length), space.get("pairs", 4 * length)
    gaussian_of = space.get("Gaussians of pairs", 4 * length)
    space.run(
        "pairs",
        blocks(seen),
        size=space.uniform("sizes of pairs", "IIII", count, tiles, tiles_x, length),
        length=num_visible,
        gaussians=ordered,
        first=first,
        tile_counts=p.tile_counts,
        records=p.records,
        boxes=p.boxes,
        tiles=tile_of,
        numbers=numbers,
        gaussian_of=gaussian_of,
        slots=slots,
    )
    if length:
        tile_of, numbers = sort(
            space, tile_of, numbers, space.uniform("length", "I", length), capacity=length,
            bits=tiles.bit_length(),
        )  # fmt: skip
        sizes = space.uniform("sizes of ranges", "II", length, tiles)
        space.run("ranges", blocks(length), size=sizes, tile_of=tile_of, ranges=ranges)
    return Lists(p, seen, dropped, length, gaussian_of, numbers, ranges, slots)


def _visible_by_depth(space: Workspace, projection: Projection) -> tuple[Buffer, Buffer]:
    """The visible Gaussians front to back, and their number."""
    gpu, count = space.gpu, projection.scene.count
    places = space.get("places of visible Gaussians", 4 * count)
    gpu.copy(projection.visible, 0, places, 0, 4 * count)
    scan(space, places, count)
    depths, visible = space.get("depths", 4 * count), space.get("visible Gaussians", 4 * count)
    num_visible = space.get("number of visible Gaussians", 4)
    gpu.clear(num_visible)
    space.run(
        "compact",
        blocks(count),
        size=gpu.uniform("I", count),
        records=projection.records,
        radii=projection.radii,
        places=places,
        depths=depths,
        gaussians=visible,
        length=num_visible,
    )
    _, ordered = sort(space, depths, visible, num_visible, capacity=count, bits=DEPTH_BITS)
    return ordered, num_visible


def blend(space: Workspace, lists: Lists) -> Image:
    """Composite the image."""
    width, height = lists.projection.size
    arrays = {
        "color": space.get("image", 12 * width * height),
        "planes": space.get("alpha and depths", 12 * width * height),
        "ends": space.get("ends of pixels", 4 * width * height),
    }
    _run_in_bands(space, "blend", lists, **arrays)
    return Image(lists, **arrays)


def backward(
    space: Workspace,
    image: Image,
    d_color: Buffer,
    d_planes: Buffer,
    rates: AdamRates | None,
    **more: Buffer,
) -> Buffer:
    """The gradients of the parameters (sections of ``layout.GRADIENTS``), from the gradients on the
    colour (H, W, 3) and on alpha and depth (2, H, W).

    Args:
        rates: The rates of ``ShAdam``, which updates the SH coefficients; None: it does not.
        more: ``exp_avg``, ``exp_avg_sq`` and ``last_step`` of SH coefficients that are updated, or
            ``d_sh``; ``d_camera`` for the Gaussians' parts of the camera's gradients.
    """
    lists, projection = image.lists, image.lists.projection
    scene = projection.scene
    slots = space.get("slots of gradients", layout.SLOT_BYTES * lists.length)
    _run_in_bands(
        space, "blend_backward", lists, color=image.color, planes=image.planes, ends=image.ends,
        d_color=d_color, d_planes=d_planes, slots=slots,
    )  # fmt: skip
    flags = layout.SH_ADAM * (rates is not None) | layout.CAMERA * ("d_camera" in more)
    gradients = space.get("gradients", 4 * layout.floats(layout.GRADIENTS) * scene.count)
    space.run(
        "project_backward",
        blocks(scene.count),
        view=projection.view,
        adam=uniform(space, "Adam of SH", rates or NO_RATES, scene.count, flags=flags),
        geometry=scene.geometry,
        sh=scene.sh,
        records=projection.records,
        tile_counts=projection.tile_counts,
        slot_of=lists.slots,
        slots=slots,
        gradients=gradients,
        **more,
    )
    return gradients


def camera_gradients(space: Workspace, rows: Buffer, count: int) -> CameraGradients:
    """The sum of the Gaussians' parts (N, ``CAMERA_PARAMETERS``)."""
    total = torch.from_numpy(sum_rows(space, rows, count, layout.CAMERA_PARAMETERS))
    return CameraGradients(*total.split([3, 3, 2, 2]))


def _run_in_bands(space: Workspace, kernel: str, lists: Lists, **buffers: Buffer) -> None:
    """Run a kernel of tiles in bands of at most ``TILES_OF_BAND`` tiles."""
    across, down = layout.tiles_of(*lists.projection.size)
    rows = max(1, TILES_OF_BAND // across)
    for first in range(0, down, rows):
        if first:
            space.gpu.submit()
        band = across, min(rows, down - first), 1
        first_row = space.gpu.uniform("I", first)
        space.run(kernel, band, first_row=first_row, **lists.by_tile, **buffers)
