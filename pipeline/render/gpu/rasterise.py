"""The kernels of a rendered view and of its gradients, in order."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.render.gpu import layout
from pipeline.render.gpu.device import Buffer, Gpu, blocks
from pipeline.render.gpu.sort import scan, sort
from pipeline.render.gpu.workspace import Workspace
from pipeline.runtime.errors import UserError

# Slots of gradients are the largest array: more pairs do not fit into 4 GB, WebGPU's offsets.
MAX_INTERSECTIONS = (1 << 32) // layout.SLOT_BYTES - 1
DEPTH_BITS = 32
# Of one dispatch: an image of 1024 x 1024 pixels.
TILES_OF_BAND = 4096


@dataclass(frozen=True)
class Scene:
    """The parameters of ``count`` Gaussians on the device.

    Attributes:
        geometry: the sections ``layout.GEOMETRY``.
        sh: (N, K, 3), K = ``coefficients``.
    """

    count: int
    coefficients: int
    geometry: Buffer
    sh: Buffer


@dataclass(frozen=True)
class Projection:
    """The Gaussians on the image plane; arrays of N.

    Attributes:
        view: ``View``.
        size: (width, height) of the image.
        records, boxes: ``Record`` and ``Box``, of visible Gaussians.
        radii: see ``Forward.radii``.
        tile_counts: number of tiles of each Gaussian.
        visible: 1 for visible Gaussians, else 0.
        dropped: see ``Forward.num_dropped``.
    """

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
        num_visible, num_dropped: see ``Forward``.
        length: number of pairs.
        gaussian_of: the Gaussian of each pair.
        pairs: the pairs, by tile and front to back.
        ranges: the range of each tile in ``pairs``.
        slots: the first pair of each Gaussian.
    """

    num_visible: int
    num_dropped: int
    length: int
    gaussian_of: Buffer
    pairs: Buffer
    ranges: Buffer
    slots: Buffer


@dataclass(frozen=True)
class Image:
    """A rendered view: ``color`` (H, W, 3); ``planes`` alpha, depth and median depth (3, H, W);
    ``ends`` (H, W) of blend.wgsl."""

    color: Buffer
    planes: Buffer
    ends: Buffer


def project(
    gpu: Gpu, space: Workspace, scene: Scene, view: Buffer, size: tuple[int, int]
) -> Projection:
    """Project all Gaussians."""
    count = scene.count
    result = Projection(
        view=view,
        size=size,
        records=space.get("records", layout.RECORD_BYTES * count),
        boxes=space.get("boxes", layout.BOX_BYTES * count),
        radii=space.get("radii", 4 * count),
        tile_counts=space.get("tile counts", 4 * count),
        visible=space.get("visible", 4 * count),
        dropped=space.get("dropped", 4),
    )
    gpu.clear(result.dropped)
    space.run(
        "project",
        blocks(count),
        view=view,
        geometry=scene.geometry,
        sh=scene.sh,
        records=result.records,
        boxes=result.boxes,
        radii=result.radii,
        tile_counts=result.tile_counts,
        visible=result.visible,
        dropped=result.dropped,
    )
    return result


def list_pairs(gpu: Gpu, space: Workspace, projection: Projection, count: int) -> Lists:
    """List the Gaussians that overlap each tile, front to back.

    Raises:
        UserError: too many pairs.
    """
    p = projection
    tiles_x, tiles_y = layout.tiles_of(*p.size)
    tiles = tiles_x * tiles_y
    ranges = space.get("tile ranges", 8 * tiles)
    gpu.clear(ranges)
    slots = space.get("slots of Gaussians", 4 * count)
    size = gpu.uniform("I", count)
    places = space.get("places of visible Gaussians", 4 * count)
    gpu.copy(p.visible, 0, places, 0, 4 * count)
    scan(gpu, space, places, count)
    depths, visible = space.get("depths", 4 * count), space.get("visible Gaussians", 4 * count)
    num_visible = space.get("number of visible Gaussians", 4)
    gpu.clear(num_visible)
    space.run(
        "compact",
        blocks(count),
        size=size,
        records=p.records,
        radii=p.radii,
        places=places,
        depths=depths,
        gaussians=visible,
        length=num_visible,
    )
    _, ordered = sort(gpu, space, depths, visible, num_visible, capacity=count, bits=DEPTH_BITS)
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
    scan(gpu, space, first, count + 1)
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
            gpu, space, tile_of, numbers, space.uniform("length", "I", length),
            capacity=length, bits=tiles.bit_length(),
        )  # fmt: skip
        space.run(
            "ranges",
            blocks(length),
            size=space.uniform("sizes of ranges", "II", length, tiles),
            tile_of=tile_of,
            ranges=ranges,
        )
    return Lists(seen, dropped, length, gaussian_of, numbers, ranges, slots)


def blend(gpu: Gpu, space: Workspace, projection: Projection, lists: Lists) -> Image:
    """Composite the image."""
    width, height = projection.size
    pixels = width * height
    image = Image(
        color=space.get("image", 12 * pixels),
        planes=space.get("alpha and depths", 12 * pixels),
        ends=space.get("ends of pixels", 4 * pixels),
    )
    _run_in_bands(
        gpu,
        space,
        "blend",
        projection.size,
        **_by_tile(projection, lists),
        color=image.color,
        planes=image.planes,
        ends=image.ends,
    )
    return image


def blend_backward(
    gpu: Gpu,
    space: Workspace,
    projection: Projection,
    lists: Lists,
    image: Image,
    d_color: Buffer,
    d_planes: Buffer,
) -> Buffer:
    """The slots of gradients (``moments.wgsl``), from the gradients on the colour (H, W, 3) and on
    alpha and depth (2, H, W)."""
    slots = space.get("slots of gradients", layout.SLOT_BYTES * lists.length)
    _run_in_bands(
        gpu,
        space,
        "blend_backward",
        projection.size,
        **_by_tile(projection, lists),
        ends=image.ends,
        color=image.color,
        planes=image.planes,
        d_color=d_color,
        d_planes=d_planes,
        slots=slots,
    )
    return slots


def _by_tile(projection: Projection, lists: Lists) -> dict[str, Buffer]:
    """What the kernels of tiles read: the Gaussians of each tile, front to back."""
    return {
        "view": projection.view,
        "records": projection.records,
        "gaussian_of": lists.gaussian_of,
        "pairs": lists.pairs,
        "ranges": lists.ranges,
    }


def _run_in_bands(
    gpu: Gpu, space: Workspace, kernel: str, size: tuple[int, int], **buffers: Buffer
) -> None:
    """Run a kernel of tiles in bands of at most ``TILES_OF_BAND`` tiles."""
    across, down = layout.tiles_of(*size)
    rows = max(1, TILES_OF_BAND // across)
    for first in range(0, down, rows):
        if first:
            gpu.submit()
        band = across, min(rows, down - first), 1
        space.run(kernel, band, first_row=gpu.uniform("I", first), **buffers)


def project_backward(
    space: Workspace,
    scene: Scene,
    projection: Projection,
    lists: Lists,
    slots: Buffer,
    options: Buffer,
    **more: Buffer,
) -> Buffer:
    """The gradients of the parameters (sections of ``layout.GRADIENTS``), from the slots.

    Args:
        options: ``Options`` in project_backward.wgsl.
        more: as the options say: ``d_sh``, or ``exp_avg``, ``exp_avg_sq`` and ``last_step`` of SH
            coefficients that are updated; ``d_camera``.
    """
    gradients = space.get("gradients", 4 * layout.floats(layout.GRADIENTS) * scene.count)
    space.run(
        "project_backward",
        blocks(scene.count),
        view=projection.view,
        options=options,
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
