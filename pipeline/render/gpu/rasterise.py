"""The kernels of a rendered view and of its gradients, in order."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pipeline.render.gpu import layout
from pipeline.render.gpu.adam import uniform
from pipeline.render.gpu.device import Buffer, Gpu, blocks
from pipeline.render.gpu.primitives import BLOCK, sort
from pipeline.render.gpu.workspace import Workspace
from pipeline.render.types import AdamRates, CameraGradients
from pipeline.runtime.errors import UserError

# Slots of gradients are the largest array: more pairs do not fit into 4 GB, WebGPU's offsets.
MAX_INTERSECTIONS = (1 << 32) // layout.SLOT_BYTES - 1
DEPTH_BITS = 31  # Depths are positive float32.
TOTALS = 4  # The words of ``Totals``.
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
        records: ``Record`` of the visible Gaussians.
        radii: See ``Forward.radii``.
        tile_counts: The number of tiles of each Gaussian.
        depths: The bits of the depths of visible Gaussians, 0 for others, until ``sort_visible``.
        dropped: One uint32, the sum of ``Forward.num_dropped`` since the buffer was made.
    """

    scene: Scene
    view: Buffer
    size: tuple[int, int]
    records: Buffer
    radii: Buffer
    tile_counts: Buffer
    depths: Buffer
    dropped: Buffer


@dataclass(frozen=True)
class Visible:
    """The visible Gaussians, front to back, and the ranges of their pairs.

    Attributes:
        gaussians: The visible Gaussians, front to back.
        count: One uint32, the number of visible Gaussians.
        first: The number of the first pair of each visible Gaussian, in its block of ``BLOCK``
            visible Gaussians.
        before: The number of pairs of each block; from ``admit`` on, of all blocks before it.
        ranges: The buffer of ``Lists.ranges``, whose ranges are still empty.
    """

    projection: Projection
    gaussians: Buffer
    count: Buffer
    first: Buffer
    before: Buffer
    ranges: Buffer


@dataclass(frozen=True)
class Totals:
    """The numbers of a step, as admit.wgsl writes them.

    Attributes:
        stopped: Whether the step was not made.
        pairs: The number of (Gaussian, tile) pairs.
        visible: See ``Forward.num_visible``.
        dropped: The sum of ``Forward.num_dropped`` since the projection's buffers were made.
    """

    stopped: bool
    pairs: int
    visible: int
    dropped: int

    @staticmethod
    def of(words: NDArray[np.uint32]) -> Totals:
        stopped, pairs, visible, dropped = map(int, words)
        return Totals(stopped != 0, pairs, visible, dropped)

    def require_listable(self) -> None:
        """Raise a UserError if there are too many pairs for any arrays."""
        if self.pairs > MAX_INTERSECTIONS:
            raise UserError(
                f"{self.visible} Gaussians overlap more than {MAX_INTERSECTIONS} tiles of 16 x 16 "
                "pixels in one view",
                fix="render smaller images, or remove Gaussians that are far too large",
            )


@dataclass(frozen=True)
class Lists:
    """The (Gaussian, tile) pairs. Pairs are numbered by depth of their Gaussian.

    Attributes:
        capacity: The number of pairs that the arrays hold.
        gaussian_of: The Gaussian of each pair.
        pairs: The pairs, by tile and front to back.
        ranges: The range of each tile in ``pairs``.
        slots: The first pair of each Gaussian.
    """

    projection: Projection
    capacity: int
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
        planes: (3, H, W), alpha, depth and median depth; None if they were not asked for.
        ends: (H, W), see blend.wgsl.
    """

    lists: Lists
    color: Buffer
    planes: Buffer | None
    ends: Buffer

    def plane(self, gpu: Gpu, number: int) -> Tensor:
        """(H, W), a copy of one of the planes."""
        assert self.planes is not None
        width, height = self.lists.projection.size
        pixels = width * height
        found = gpu.read(self.planes, np.float32, pixels, 4 * pixels * number)
        return torch.from_numpy(found).view(height, width)


def project(space: Workspace, scene: Scene, view: Buffer, size: tuple[int, int]) -> Projection:
    """Project all Gaussians."""
    count = scene.count
    arrays = {
        "records": space.get("records", layout.RECORD_BYTES * count),
        "radii": space.get("radii", 4 * count),
        "tile_counts": space.get("tile counts", 4 * count),
        "depths": space.get("depths", 4 * count),
        "dropped": space.get("dropped", 4),
    }
    space.run("project", blocks(count), view=view, geometry=scene.geometry, sh=scene.sh, **arrays)
    return Projection(scene, view, size, **arrays)


def sort_visible(space: Workspace, projection: Projection) -> Visible:
    """Sort the visible Gaussians by depth and count their pairs. Overwrites
    ``projection.depths``."""
    gpu, p, count = space.gpu, projection, projection.scene.count
    length = gpu.uniform("I", count)
    visible = sort(space, "visible Gaussians", p.depths, length, capacity=count, bits=DEPTH_BITS)
    tiles = math.prod(layout.tiles_of(*p.size))
    arrays = {
        "first": space.get("first pairs", 4 * count),
        "sums": space.get("pairs of blocks", 4 * blocks(count, BLOCK)),
        "ranges": space.get("tile ranges", 8 * tiles),
    }
    space.run(
        "order",
        blocks(max(count, tiles), BLOCK),
        size=gpu.uniform("I", tiles),
        length=visible.count,
        gaussians=visible.order,
        tile_counts=p.tile_counts,
        **arrays,
    )
    return Visible(p, visible.order, visible.count, *arrays.values())


def admit(
    space: Workspace, visible: Visible, capacity: int, stopped: Buffer, results: Buffer, at: int = 0
) -> Buffer:
    """Number the pairs, and decide on the device whether a step of these Gaussians is made
    (admit.wgsl).

    Args:
        capacity: The number of pairs that the arrays of the step hold.
        stopped: One uint32; not zero if a step before was not made.
        results: The buffer for ``Totals``, at its word ``at``.

    Returns:
        One uint32, the number of pairs to list: none if the step is not made.
    """
    length = space.get("number of listed pairs", 4)
    space.run(
        "admit",
        1,
        size=space.gpu.uniform("II", capacity, at),
        num_visible=visible.count,
        before=visible.before,
        dropped=visible.projection.dropped,
        stopped=stopped,
        length=length,
        results=results,
    )
    return length


def fill_lists(space: Workspace, visible: Visible, length: Buffer, capacity: int) -> Lists:
    """List the pairs.

    Args:
        length: The result of ``admit``.
        capacity: At least the number of pairs.
    """
    p, gpu = visible.projection, space.gpu
    count, (tiles_x, tiles_y) = p.scene.count, layout.tiles_of(*p.size)
    used = gpu.counts.listed(capacity)
    keys = space.get("tiles of pairs", 4 * capacity, 4 * used)
    gaussian_of = space.get("Gaussians of pairs", 4 * capacity, 4 * used)
    slots = space.get("slots of Gaussians", 4 * count)
    space.run(
        "pairs",
        blocks(count),
        size=gpu.uniform("II", tiles_x, capacity),
        length=visible.count,
        gaussians=visible.gaussians,
        first=visible.first,
        before=visible.before,
        tile_counts=p.tile_counts,
        records=p.records,
        keys=keys,
        gaussian_of=gaussian_of,
        slots=slots,
    )
    bits = (tiles_x * tiles_y).bit_length()
    pairs = sort(space, "pairs", keys, length, capacity=capacity, bits=bits, used=used)
    arrays = {"keys": pairs.keys, "ranges": visible.ranges}
    space.run("ranges", blocks(capacity), length=pairs.count, **arrays)
    return Lists(p, capacity, gaussian_of, pairs.order, visible.ranges, slots)


def list_pairs(space: Workspace, projection: Projection) -> tuple[Lists, Totals]:
    """List the Gaussians that overlap each tile, front to back, in arrays of the needed size; waits
    for their number. Overwrites ``projection.depths``.

    Raises:
        UserError: There are too many pairs.
    """
    visible = sort_visible(space, projection)
    stopped, results = space.get("stopped", 4), space.get("totals", 4 * TOTALS)
    length = admit(space, visible, (1 << 32) - 1, stopped, results)
    totals = Totals.of(space.gpu.read(results, np.uint32, TOTALS))
    totals.require_listable()
    return fill_lists(space, visible, length, totals.pairs), totals


def blend(space: Workspace, lists: Lists, *, planes: bool) -> Image:
    """Composite the image.

    Args:
        planes: Whether alpha and depths are written.
    """
    width, height = lists.projection.size
    color = space.get("image", 12 * width * height)
    ends = space.get("ends of pixels", 4 * width * height)
    found = space.get("alpha and depths", 12 * width * height) if planes else None
    _run_in_bands(space, "blend", lists, {"planes": found}, color=color, ends=ends)
    return Image(lists, color, found, ends)


def blend_backward(
    space: Workspace, image: Image, d_color: Buffer, d_planes: Buffer | None
) -> Buffer:
    """The slots of gradients of all pairs, from the gradients on the colour (H, W, 3) and on alpha
    and depth (2, H, W).

    Args:
        d_planes: None: they are zero. Otherwise, the image needs its planes.
    """
    lists = image.lists
    used = space.gpu.counts.listed(lists.capacity)
    slots = space.get(
        "slots of gradients", layout.SLOT_BYTES * lists.capacity, layout.SLOT_BYTES * used
    )
    planes = {"planes": None if d_planes is None else image.planes, "d_planes": d_planes}
    _run_in_bands(
        space, "blend_backward", lists, planes, color=image.color, ends=image.ends,
        d_color=d_color, slots=slots,
    )  # fmt: skip
    return slots


def project_backward(
    space: Workspace, lists: Lists, slots: Buffer, rates: AdamRates | None, **more: Buffer
) -> Buffer:
    """The gradients of the parameters (sections of ``layout.GRADIENTS``).

    Args:
        slots: The result of ``blend_backward``.
        rates: The rates of ``ShAdam``, which updates the SH coefficients; None: it does not.
        more: ``exp_avg``, ``exp_avg_sq`` and ``last_step`` of SH coefficients that are updated, or
            ``d_sh``; ``d_camera`` for the Gaussians' parts of the camera's gradients.
    """
    scene = lists.projection.scene
    flags = layout.SH_ADAM * (rates is not None) | layout.CAMERA * ("d_camera" in more)
    gradients = space.get("gradients", 4 * layout.floats(layout.GRADIENTS) * scene.count)
    space.run(
        "project_backward",
        blocks(scene.count),
        adam=uniform(space, "Adam of SH", rates or NO_RATES, scene.count, flags=flags),
        gradients=gradients,
        **slots_of_gaussians(lists, slots),
        **more,
    )
    return gradients


def slots_of_gaussians(lists: Lists, slots: Buffer) -> dict[str, Buffer]:
    """The buffers from which gradient.wgsl computes gradients of Gaussians."""
    projection = lists.projection
    return {
        "view": projection.view,
        "geometry": projection.scene.geometry,
        "sh": projection.scene.sh,
        "tile_counts": projection.tile_counts,
        "slot_of": lists.slots,
        "slots": slots,
    }


def camera_gradients(total: NDArray[np.float64]) -> CameraGradients:
    """The gradients of the camera, from the sum of the Gaussians' parts (``CAMERA_PARAMETERS``)."""
    return CameraGradients(*torch.from_numpy(total).split([3, 3, 2, 2]))


def _run_in_bands(
    space: Workspace,
    kernel: str,
    lists: Lists,
    planes: Mapping[str, Buffer | None],
    **buffers: Buffer,
) -> None:
    """Run a kernel of tiles in bands of at most ``TILES_OF_BAND`` tiles, with all of ``planes`` or
    with none."""
    given = {name: buffer for name, buffer in planes.items() if buffer is not None}
    assert not given or len(given) == len(planes)
    flags = layout.PLANES if given else 0
    across, down = layout.tiles_of(*lists.projection.size)
    rows = max(1, TILES_OF_BAND // across)
    for first in range(0, down, rows):
        if first:
            space.gpu.submit()
        groups = across, min(rows, down - first), 1
        band = space.gpu.uniform("II", first, flags)
        arrays = {"band": band, **lists.by_tile, **buffers, **given}
        space.run(kernel, groups, groups[1] / down, **arrays)
