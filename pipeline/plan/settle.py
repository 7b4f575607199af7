"""Replacing options that are "auto" by values that suit the scene, with reasons.

``settle`` is pure and idempotent: the same scan and config give the same ``Settled``, and settling
a settled config changes nothing.
"""

from __future__ import annotations

import math
import posixpath
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from pipeline.config import settled
from pipeline.config.schema import MAX_BLOCKS, Config
from pipeline.io.posefiles import MIN_IMAGES_PER_CAMERA
from pipeline.plan.budget import gaussian_budget, typical_view
from pipeline.plan.panoramas import check_panorama_sizes
from pipeline.plan.published import as_published, published_line
from pipeline.plan.scan import Scan
from pipeline.plan.training_memory import MEMORY_MARGIN, blocks_in, in_blocks_mb, memory_mb
from pipeline.runtime.errors import UserError
from pipeline.scene.collection import MIXED_BODIES, MIXED_GROUP_SHARE, camera_bodies

# Up to this many photographs (780 pairs), all pairs are matched. For more, retrieval takes a
# fraction of the time.
MAX_EXHAUSTIVE_PHOTOS = 40
# GPS errors are several metres, so spatial matching needs a much larger scene (diagonal in metres)
# and positions of most photographs.
MIN_SPATIAL_EXTENT_M = 50.0
MIN_SPATIAL_SHARE = 0.9
# Up to this many photographs, depths improve test views: those of depth maps, or of sparse points.
FEW_PHOTOS, SPARSE_DEPTH_WEIGHT = 30, 0.03
DEPTH_MAP_WEIGHT = 0.3
# Scenes of more photographs are trained in blocks, one for each PHOTOS_PER_BLOCK.
MAX_PHOTOS_OF_ONE_BLOCK, PHOTOS_PER_BLOCK = 1000, 250
# Two photographs are the fewest that show a part of a scene from several sides.
MIN_PHOTOS_OF_A_BLOCK = 2
# Features and matches of more photographs are computed in several jobs, one for each
# PHOTOS_PER_JOB. A job of 250 photographs takes minutes on two cores; to start one takes seconds.
MAX_PHOTOS_OF_ONE_JOB, PHOTOS_PER_JOB = 500, 250
# Jobs of matching depend on all jobs of extraction: Snakemake would plan more of them for minutes.
MAX_JOBS = 200

_EARTH_RADIUS_M = 6_371_000.0
Choice = tuple[str, str]
"""An option's value, and the sentence that gives the value and the reason."""
PROCESSOR: Choice = ("cpu", "")
"""The device of a machine without a GPU."""


@dataclass(frozen=True)
class Settled:
    """A config whose options are no longer "auto".

    Attributes:
        why: The sentence that gives an option's value and the reason, by the option's dotted path.
    """

    config: settled.Config
    why: Mapping[str, str]


def settle(scan: Scan, config: Config, device: Choice = PROCESSOR) -> Settled:
    """Settle the options for a scene.

    Args:
        device: The machine's device, for ``train.device: auto``.

    Raises:
        UserError: ``partition.memory_mb`` is too small, there are more ``partition.blocks`` than
            the photographs allow, the scene of ``split.source: published`` is in no published
            benchmark, or appearance embeddings or transients are set for a scene in blocks.
    """
    config = as_published(scan, config)
    chosen = {
        "matches.pairs": _pairs(scan, config),
        "sfm.mapper": _mapper(config),
        "sfm.camera_model": _camera_model(scan, config),
        "sfm.share_cameras": _share_cameras(scan, config),
        "train.background": _background(scan, config),
        "train.device": _device(config, device),
    }
    value = {path: choice for path, (choice, _) in chosen.items()}
    photos_per_job, jobs_reason = _photos_per_job(scan, config)
    budget, budget_reason = gaussian_budget(scan, config)
    blocks, blocks_reason = _blocks(scan, config, budget)
    if blocks > 1 and config.train.appearance == "embedding":
        raise UserError(
            f"train.appearance: embedding is not available in blocks, and the scene has {blocks}",
            fix="set train.appearance: exposure, or partition.blocks: 1",
        )
    method = _init_method(scan, config)
    transients, transients_reason = _transients(scan, config, blocks)
    depth_weight, depth_reason = _depth_loss_weight(scan, config, method == "dense" and blocks == 1)
    replaced = _updated(
        config,
        {
            "inspect": {"image_folder": scan.image_folder},
            "features": {"photos_per_job": photos_per_job},
            "matches": {"pairs": value["matches.pairs"]},
            "sfm": {
                name: value[f"sfm.{name}"] for name in ("mapper", "camera_model", "share_cameras")
            }
            | {"georeference": _georeference(scan, config)},
            "init": {
                "method": method,
                "max_points": min(config.init.max_points, max(1, budget // 2)),
                "points_file": scan.cloud.path if scan.cloud else "none",
            },
            "partition": {"blocks": blocks},
            "train": {
                "background": value["train.background"],
                "device": value["train.device"],
                "transients": transients,
                "depth_loss_weight": depth_weight,
                "density": config.train.density.model_copy(update={"max_gaussians": budget}),
            },
        },
    )
    why = {path: reason for path, (_, reason) in chosen.items()}
    why |= {"train.density.max_gaussians": budget_reason, "views.masks": _masks(scan, config)}
    why["train.depth_loss_weight"] = depth_reason
    why["train.transients"] = transients_reason
    why["partition.blocks"] = blocks_reason
    why["split.source"] = published_line(scan, config)
    why["features.photos_per_job"] = jobs_reason
    return Settled(replaced, why)


def _pairs(scan: Scan, config: Config) -> Choice:
    count, wanted = len(scan.planned), config.matches.pairs
    if wanted != "auto":
        return wanted, f"{wanted} pairs, as configured"
    if count <= MAX_EXHAUSTIVE_PHOTOS:
        return (
            "exhaustive",
            f"exhaustive pairs: all {count * (count - 1) // 2} of {count} photographs",
        )
    metres = gps_extent_m(scan)
    if scan.num_gps >= MIN_SPATIAL_SHARE * count and metres >= MIN_SPATIAL_EXTENT_M:
        return "spatial", f"spatial pairs: GPS in {scan.num_gps} of {count}, {metres:.0f} m across"
    if scan.ordered is not None:
        return "sequential", f"sequential pairs: {count} photographs, {scan.ordered}"
    return (
        "retrieval",
        f"retrieval pairs: {count} photographs are too many for all pairs, and neither a sequence "
        "nor GPS positions give neighbours",
    )


def gps_extent_m(scan: Scan) -> float:
    """The diagonal of the GPS positions' bounding box in metres; 0 without positions."""
    positions = [photo.gps for photo in scan.photos if photo.gps is not None]
    if not positions:
        return 0.0
    north = [math.radians(position[0]) * _EARTH_RADIUS_M for position in positions]
    # Longitudes are relative to the first: a scene may lie on both sides of the date line.
    cos_latitude = math.cos(math.radians(positions[0][0]))
    east = [
        math.radians((position[1] - positions[0][1] + 180) % 360 - 180)
        * cos_latitude
        * _EARTH_RADIUS_M
        for position in positions
    ]
    return math.hypot(max(north) - min(north), max(east) - min(east))


def _mapper(config: Config) -> Choice:
    wanted = config.sfm.mapper
    if wanted != "auto":
        return wanted, f"{wanted} mapper, as configured"
    # Incremental mapping takes time linear in the number of photographs, global mapping quadratic.
    return "incremental", "incremental mapper; the global mapper if its model is not good"


def _camera_model(scan: Scan, config: Config) -> Choice:
    wanted = config.sfm.camera_model
    count, whole = scan.num_panoramas, len(scan.planned)
    if wanted == "EQUIRECTANGULAR":
        check_panorama_sizes(scan.planned)
        return (
            wanted,
            f"EQUIRECTANGULAR cameras: panoramas of 360 degrees{_configured(count, whole)}",
        )
    if count == whole:
        return "EQUIRECTANGULAR", "EQUIRECTANGULAR cameras: all photographs are panoramas"
    choice, text = _perspective_model(scan, config)
    if count:
        text += f"; EQUIRECTANGULAR cameras for {count} panoramas"
    return choice, text


def _configured(found: int, count: int) -> str:
    """The end of the sentence about panoramas: whether the photographs themselves say so."""
    return "" if found == count else ", as configured"


def _perspective_model(scan: Scan, config: Config) -> Choice:
    """The model of the cameras of the photographs that are not panoramas."""
    wanted = config.sfm.camera_model
    priors = f"focal length from EXIF in {scan.num_focal} of {len(scan.planned)} photographs"
    if wanted != "auto":
        return wanted, f"{wanted} cameras, as configured; {priors}"
    if any("fisheye" in photo.camera_group.casefold() for photo in scan.photos):
        return "OPENCV_FISHEYE", f"OPENCV_FISHEYE cameras: EXIF names a fisheye lens; {priors}"
    return "SIMPLE_RADIAL", f"SIMPLE_RADIAL cameras; {priors}"


def _share_cameras(scan: Scan, config: Config) -> Choice:
    wanted = config.sfm.share_cameras
    if wanted != "auto":
        return wanted, f"cameras shared by {wanted}, as configured"
    groups = {photo.camera_group for photo in scan.planned}
    bodies = camera_bodies(groups)
    count = len(scan.planned)
    if len(bodies) >= MIXED_BODIES:
        return "image", f"one camera per image: photographs by {len(bodies)} different cameras"
    if count > 2 and len(groups) > MIXED_GROUP_SHARE * count:
        return "image", f"one camera per image: {len(groups)} groups in {count} photographs"
    folders = Counter(posixpath.dirname(photo.name) for photo in scan.planned)
    if len(folders) > 1 and min(folders.values()) >= MIN_IMAGES_PER_CAMERA:
        return "folder", f"cameras shared within each of {len(folders)} folders"
    each = "one camera" if len(groups) == 1 else f"{len(groups)} cameras"
    return "group", f"{each}, shared by body, lens, focal length and size"


def _background(scan: Scan, config: Config) -> Choice:
    wanted = config.train.background
    if wanted != "auto":
        return wanted, f"{wanted} background, as configured"
    if 2 * scan.num_alpha > len(scan.planned):
        return "white", f"white background: {scan.num_alpha} photographs have alpha"
    if scan.num_alpha:
        return "black", f"black background: only {scan.num_alpha} photographs have alpha"
    if config.train.density.strategy == "original":
        return "black", "black background, as published"
    return "measured", (
        "behind the scene, what init finds in the photographs: a skybox if they show sky, the "
        "colour of a backdrop, else a fill"
    )


def _georeference(scan: Scan, config: Config) -> str:
    wanted = config.sfm.georeference
    if wanted != "auto":
        return wanted
    if scan.ground_control is not None:
        return "gcp"
    return "gps" if scan.num_gps else "none"


def _device(config: Config, device: Choice) -> Choice:
    wanted = config.train.device
    if wanted == "auto":
        return device
    if wanted == "cpu":
        return wanted, ""
    number = wanted.removeprefix("gpu").removeprefix(":") or "0"
    return f"gpu:{number}", f"trained on GPU {number}, as configured"


def _init_method(scan: Scan, config: Config) -> str:
    """What Gaussians are initialised from: depth maps for few photographs, unless points or depths
    are given. Scenes with alpha, masks or panoramas use none: their benefit there is not known."""
    if config.init.method != "auto":
        return config.init.method
    other = scan.cloud is not None or scan.num_alpha or scan.num_masks or scan.num_depths
    few = len(scan.planned) <= FEW_PHOTOS and not scan.num_panoramas
    return "dense" if few and not other else "points"


def _blocks(scan: Scan, config: Config, gaussians: int) -> tuple[int, str]:
    """The number of blocks of a scene that has at most ``gaussians`` Gaussians, and the reason.

    Raises:
        UserError: More blocks are configured than there are photographs for, or
            ``partition.memory_mb`` is not enough for this number, or for any.
    """
    wanted, count, limit = config.partition.blocks, len(scan.planned), config.partition.memory_mb
    blocks, reason = 1, ""
    if wanted != "auto":
        _check_blocks(wanted, count)
        blocks, reason = wanted, f"{wanted} blocks, as configured" if wanted > 1 else ""
    elif count > MAX_PHOTOS_OF_ONE_BLOCK:
        blocks = min(math.ceil(count / PHOTOS_PER_BLOCK), MAX_BLOCKS)
        reason = f"{blocks} blocks: one for every {PHOTOS_PER_BLOCK} of {count} photographs"
    # If one block is configured, the number of Gaussians is already what fits.
    one_fits = wanted == 1 or MEMORY_MARGIN * memory_mb(0, gaussians) <= (limit or math.inf)
    if limit is None or (blocks == 1 and one_fits):
        return blocks, reason
    width, height = typical_view(scan, config)
    size = width * height, gaussians
    if wanted == "auto" and (needed := blocks_in(limit / MEMORY_MARGIN, *size)) > blocks:
        blocks, reason = needed, f"{needed} blocks, which fit into {limit} MB of memory each"
    if (least := math.ceil(MEMORY_MARGIN * in_blocks_mb(*size, blocks))) > limit:
        number = "any number of" if wanted == "auto" else wanted
        raise UserError(
            f"partition.memory_mb: {limit} MB are not enough to train {gaussians} Gaussians in "
            f"{number} blocks; {least} are needed",
            fix="increase it, or lower train.density.max_gaussians",
        )
    return blocks, reason


def _check_blocks(wanted: int, count: int) -> None:
    most = max(1, count // MIN_PHOTOS_OF_A_BLOCK)
    if wanted > most:
        raise UserError(
            f"partition.blocks: expected at most {most} blocks for {count} photographs, found "
            f"{wanted}: a block needs at least {MIN_PHOTOS_OF_A_BLOCK} photographs",
            fix="lower it, or leave it out",
        )


def _photos_per_job(scan: Scan, config: Config) -> tuple[int, str]:
    """The maximum number of photographs of a job of extraction, which decides their number."""
    wanted, count = config.features.photos_per_job, len(scan.planned)
    size = PHOTOS_PER_JOB if count > MAX_PHOTOS_OF_ONE_JOB else max(count, 1)
    if wanted != "auto":
        size = wanted
    size = max(size, math.ceil(count / MAX_JOBS))
    jobs = math.ceil(count / size)
    if jobs > 1:
        return size, f"{jobs} jobs: one for every {size} of {count} photographs"
    return size, "features and matches are one job each"


def _masks(scan: Scan, config: Config) -> str:
    if config.views.masks == "ignore":
        return "masks ignored, as configured"
    return f"{scan.num_masks} photographs have masks" if scan.num_masks else ""


def _depth_loss_weight(scan: Scan, config: Config, dense: bool) -> tuple[float, str]:
    """The weight of the depth loss, which is 0 for many photographs without depths, and the reason.

    Args:
        dense: Whether depths by multi-view stereo are known.
    """
    wanted = config.train.depth_loss_weight
    if wanted != "auto":
        return wanted, f"the loss on depths has weight {wanted:g}, as configured"
    if scan.num_depths:
        text = f"{scan.num_depths} depth maps: the loss on depths has weight {DEPTH_MAP_WEIGHT:g}"
        return DEPTH_MAP_WEIGHT, text
    if dense:
        text = f"multi-view stereo: the loss on depths has weight {DEPTH_MAP_WEIGHT:g}"
        return DEPTH_MAP_WEIGHT, text
    if len(scan.planned) > FEW_PHOTOS:
        return 0.0, ""
    weight = SPARSE_DEPTH_WEIGHT
    return weight, f"few photographs: the loss on sparse points' depths has weight {weight:g}"


def _transients(scan: Scan, config: Config, blocks: int) -> Choice:
    """Whether training searches for transients, and why not if photographs may show some."""
    wanted = config.train.transients
    if wanted == "find" and blocks > 1:
        raise UserError(
            f"train.transients: find is not available in blocks, and the scene has {blocks}",
            fix="set train.transients: none, or partition.blocks: 1",
        )
    if wanted != "auto":
        return wanted, ""
    if scan.num_alpha or config.train.density.strategy == "original":
        return "none", ""
    if scan.num_masks:  # No masks are read with views.masks: ignore.
        return "none", "passers-by: only what the masks exclude is left out of the loss"
    if blocks > 1:
        return "none", "passers-by are not searched for in blocks"
    return "find", ""


def _updated(config: Config, changes: Mapping[str, Mapping[str, Any]]) -> settled.Config:
    sections = {
        name: getattr(config, name).model_copy(update=dict(values))
        for name, values in changes.items()
    }
    return settled.Config.model_validate(config.model_copy(update=sections).model_dump())
