"""Settles every option that is "auto" from what the scan found, and says why.

``settle`` is pure and idempotent: the same scan and config give the same ``Settled``, and a settled
config settles to itself.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from pipeline.config.schema import Config
from pipeline.plan.budget import gaussian_budget
from pipeline.plan.scan import Scan

# 40 photographs are 780 pairs: two minutes on two cores, and no pair is missed. Above it the
# neighbours that the scene's own descriptors propose give the same poses in a fraction of that.
EXHAUSTIVE_PHOTOS = 40
# GPS errs by some metres: only a capture much larger than that can be sorted by it.
SPATIAL_METRES = 50.0
SPATIAL_SHARE = 0.9
# A collection by many people: photographs of one size need not share a lens.
MIXED_BODIES = 3
MIXED_GROUP_SHARE = 0.5
# Up to so many photographs, supervision by the depths of sparse points improves test views.
FEW_PHOTOS, DEPTH_WEIGHT = 30, 0.03
MAP_WEIGHT = 0.3

_EARTH_RADIUS_M = 6_371_000.0
Choice = tuple[str, str]
"""A setting's value and the sentence that says why."""


@dataclass(frozen=True)
class Settled:
    """A config without an "auto" that the scan can settle.

    Attributes:
        why: dotted path of an option -> the sentence that gives its value and the reason.
    """

    config: Config
    why: Mapping[str, str]


def settle(scan: Scan, config: Config) -> Settled:
    """The options of the scene that ``scan`` describes.

    Raises:
        UserError: an option asks for what the scene or ``train.memory_mb`` does not allow.
    """
    chosen = {
        "matches.pairs": _pairs(scan, config),
        "sfm.mapper": _mapper(config),
        "sfm.camera_model": _camera_model(scan, config),
        "sfm.share_cameras": _share_cameras(scan, config),
        "train.background": _background(scan, config),
        "train.depth_weight": _depth_weight(scan, config),
    }
    value = {path: choice for path, (choice, _) in chosen.items()}
    budget, budget_reason = gaussian_budget(scan, config)
    settled = _updated(
        config,
        {
            "inspect": {"image_folder": scan.image_folder},
            "matches": {"pairs": value["matches.pairs"]},
            "sfm": {
                name: value[f"sfm.{name}"] for name in ("mapper", "camera_model", "share_cameras")
            },
            "init": {
                "method": "points" if config.init.method == "auto" else config.init.method,
                "max_points": min(config.init.max_points, max(1, budget // 2)),
            },
            "train": {
                "background": value["train.background"],
                "depth_weight": value["train.depth_weight"],
                "density": config.train.density.model_copy(update={"max_gaussians": budget}),
            },
        },
    )
    why = {path: reason for path, (_, reason) in chosen.items()}
    why |= {"train.density.max_gaussians": budget_reason, "views.masks": _masks(scan, config)}
    return Settled(settled, why)


def _pairs(scan: Scan, config: Config) -> Choice:
    count, wanted = len(scan.photos), config.matches.pairs
    if wanted != "auto":
        return wanted, f"{wanted} pairs, as configured"
    if count <= EXHAUSTIVE_PHOTOS:
        return (
            "exhaustive",
            f"exhaustive pairs: all {count * (count - 1) // 2} of {count} photographs",
        )
    metres = gps_extent_m(scan)
    if scan.num_gps >= SPATIAL_SHARE * count and metres >= SPATIAL_METRES:
        return "spatial", f"spatial pairs: GPS in {scan.num_gps} of {count}, {metres:.0f} m across"
    if scan.ordered is not None:
        return "sequential", f"sequential pairs: {count} photographs, {scan.ordered}"
    return (
        "retrieval",
        f"retrieval pairs: {count} photographs are too many for all pairs, and neither order nor "
        "GPS sorts them",
    )


def gps_extent_m(scan: Scan) -> float:
    """Diagonal of the GPS positions' box in metres; 0 without positions."""
    places = [photo.gps for photo in scan.photos if photo.gps is not None]
    if not places:
        return 0.0
    north = [math.radians(place[0]) * _EARTH_RADIUS_M for place in places]
    # Longitudes relative to the first, so that the date line does not tear a scene apart.
    shrink = math.cos(math.radians(places[0][0]))
    east = [
        math.radians((place[1] - places[0][1] + 180) % 360 - 180) * shrink * _EARTH_RADIUS_M
        for place in places
    ]
    return math.hypot(max(north) - min(north), max(east) - min(east))


def _mapper(config: Config) -> Choice:
    wanted = config.sfm.mapper
    if wanted != "auto":
        return wanted, f"{wanted} mapper, as configured"
    # Its time grows in proportion to the photographs, the global one's with their square.
    return "incremental", "incremental mapper; the global one where its model is not good"


def _camera_model(scan: Scan, config: Config) -> Choice:
    wanted = config.sfm.camera_model
    priors = f"focal length from EXIF in {scan.num_focal} of {len(scan.photos)} photographs"
    if wanted != "auto":
        return wanted, f"{wanted} cameras, as configured; {priors}"
    if any("fisheye" in photo.camera_group.casefold() for photo in scan.photos):
        return "OPENCV_FISHEYE", f"OPENCV_FISHEYE cameras: EXIF names a fisheye lens; {priors}"
    return "SIMPLE_RADIAL", f"SIMPLE_RADIAL cameras; {priors}"


def _share_cameras(scan: Scan, config: Config) -> Choice:
    wanted = config.sfm.share_cameras
    if wanted != "auto":
        return wanted, f"cameras shared by {wanted}, as configured"
    groups = {photo.camera_group for photo in scan.photos}
    bodies = {group.split(" | ")[0] for group in groups if " | " in group}
    count = len(scan.photos)
    if len(bodies) >= MIXED_BODIES:
        return "image", f"a camera for each image: photographs of {len(bodies)} different cameras"
    if count > 2 and len(groups) > MIXED_GROUP_SHARE * count:
        return "image", f"a camera for each image: {len(groups)} kinds in {count} photographs"
    each = "one camera" if len(groups) == 1 else f"{len(groups)} cameras"
    return "group", f"{each}, shared by body, lens, focal length and size"


def _background(scan: Scan, config: Config) -> Choice:
    wanted = config.train.background
    if wanted != "auto":
        return wanted, f"{wanted} background, as configured"
    if 2 * scan.num_alpha > len(scan.photos):
        return "white", f"white background: {scan.num_alpha} photographs have alpha"
    few = f"only {scan.num_alpha} photographs have alpha" if scan.num_alpha else "no alpha"
    return "black", f"black background: {few}"


def _masks(scan: Scan, config: Config) -> str:
    if config.views.masks == "ignore":
        return "masks ignored, as configured"
    return f"masks in {scan.num_masks} photographs" if scan.num_masks else ""


def _depth_weight(scan: Scan, config: Config) -> tuple[float, str]:
    """Whether renders are held to sparse points' depths: many photographs settle them alone."""
    wanted = config.train.depth_weight
    if wanted != "auto":
        return wanted, f"sparse points' depths have weight {wanted:g}, as configured"
    if scan.num_depths:
        return MAP_WEIGHT, f"{scan.num_depths} depth maps: depths have weight {MAP_WEIGHT:g}"
    if len(scan.photos) > FEW_PHOTOS:
        return 0.0, ""
    return DEPTH_WEIGHT, f"few photographs: sparse points' depths have weight {DEPTH_WEIGHT:g}"


def _updated(config: Config, changes: Mapping[str, Mapping[str, Any]]) -> Config:
    sections = {
        name: getattr(config, name).model_copy(update=dict(values))
        for name, values in changes.items()
    }
    return Config.model_validate(config.model_copy(update=sections).model_dump())
