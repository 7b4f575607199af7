"""What a scene needs and what it does not: the one place where that is decided.

``make_plan`` is pure: the same scan and config give the same plan. The Snakefile takes its jobs
from ``Plan.stages``, the stages take their settings from ``Plan.config``.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from pydantic import BaseModel, ConfigDict

from pipeline.config.schema import Config
from pipeline.scene.budget import gaussian_budget, memory_line, training_memory_mb
from pipeline.scene.posefiles import SHARED_BY, GivenPoses
from pipeline.scene.scan import Scan
from pipeline.scene.views import view_size

STAGES = (
    "inspect",
    "decode",
    "features",
    "matches",
    "sfm",
    "refine",
    "undistort",
    "init",
    "train",
    "evaluate",
    "export",
    "report",
)
# 40 photographs are 780 pairs: two minutes on two cores, and no pair is missed. Above it the
# neighbours that the scene's own descriptors propose give the same poses in a fraction of that.
EXHAUSTIVE_PHOTOS = 40
# GPS errs by some metres: only a capture much larger than that can be sorted by it.
SPATIAL_METRES = 50.0
SPATIAL_SHARE = 0.9
# A collection by many people: photographs of one size need not share a lens.
MIXED_BODIES = 3
MIXED_GROUP_SHARE = 0.5

# Up to so many photographs, depths of sparse points are a help (docs/training.md): 7 training views
# of a fountain gain 1.5 dB on views kept back, 8 of a door nothing, 38 of a fox lose 0.2 to 0.5 dB.
FEW_PHOTOS, DEPTH_WEIGHT = 30, 0.03
MAP_WEIGHT = 0.3

# A photograph with fewer known points is left behind when the others are adjusted to theirs.
MIN_TRACKED = 20

# A plan is for people, and travels on a command line.
FACTS_SHOWN = 20

_EARTH_RADIUS_M = 6_371_000.0
_POSE_KINDS = {"colmap": "COLMAP model", "transforms": "transforms", "llff": "LLFF poses"}
Choice = tuple[str, str]
"""A setting's value and the sentence that says why."""


class StagePlan(BaseModel):
    """Whether a stage runs, why, and what was settled for it."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    run: bool
    reason: str
    decisions: list[str] = []


class Plan(BaseModel):
    """A scene's stages in the order of the DAG, its settled config and what they rest on."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    scene: str
    stages: dict[str, StagePlan]
    warnings: list[str]
    config: Config
    facts: dict[str, Any]

    def runs(self, stage: str) -> bool:
        return self.stages[stage].run


def make_plan(scan: Scan, config: Config) -> Plan:
    """Decide what ``scan`` needs. ``Plan.config`` has no "auto" left that can be settled now."""
    pairs, pairs_reason = _pairs(scan, config)
    mapper, mapper_reason = _mapper(config)
    camera_model, model_reason = _camera_model(scan, config)
    sharing, sharing_reason = _share_cameras(scan, config)
    background, background_reason = _background(scan, config)
    budget, budget_reason = gaussian_budget(scan, config)
    depth_weight, depth_reason = _depth_weight(scan, config)
    settled = _settled(
        config,
        {
            "inspect": {"image_folder": scan.image_folder},
            "matches": {"pairs": pairs},
            "sfm": {"mapper": mapper, "camera_model": camera_model, "share_cameras": sharing},
            "init": {
                "method": "points" if config.init.method == "auto" else config.init.method,
                "max_points": min(config.init.max_points, max(1, budget // 2)),
            },
            "train": {
                "background": background,
                "depth_weight": depth_weight,
                "density": config.train.density.model_copy(update={"max_gaussians": budget}),
            },
        },
    )
    poses = scan.poses
    stages = {
        "inspect": StagePlan(
            run=True,
            reason=f"{len(scan.photos)} photographs",
            decisions=[scan.image_folder_reason],
        ),
        "decode": _decode(scan, settled),
        "features": _pose_stage(
            poses, "keypoints to find the poses by", [_keypoints(scan, config)]
        ),
        "matches": _pose_stage(poses, "pairs to find poses by", [pairs_reason]),
        "sfm": _pose_stage(
            poses,
            _why_sfm(config),
            [mapper_reason, model_reason, sharing_reason, _frame(scan, config)],
        ),
        "refine": _refine(scan, config),
        "undistort": _undistort(scan, settled),
        "init": _init(scan, settled),
        "train": StagePlan(
            run=True,
            reason=_length(settled),
            decisions=[
                _resolution(scan, settled),
                budget_reason,
                background_reason,
                *([depth_reason] if depth_reason else []),
                *_mask_lines(scan, config),
                memory_line(scan, settled),
            ],
        ),
        "evaluate": StagePlan(run=True, reason=_split(settled), decisions=_truth(scan)),
        "export": StagePlan(run=True, reason=", ".join(settled.export.formats) or "no format"),
        "report": StagePlan(run=True, reason="one page on the scene"),
    }
    return Plan(
        scene=scan.manifest.scene,
        stages=stages,
        warnings=_some(scan.warnings),
        config=settled,
        facts=_facts(scan, settled),
    )


def describe(plan: Plan) -> str:
    """The plan as a table for the terminal."""
    lines = [f"{plan.scene}: {plan.facts['photographs']} photographs"]
    for name, stage in plan.stages.items():
        lines.append(f"  {name:<10} {'run ' if stage.run else 'skip'}  {stage.reason}")
        if stage.run:
            lines += [f"  {'':<10}       - {decision}" for decision in stage.decisions]
    lines += [f"  warning: {warning}" for warning in plan.warnings]
    return "\n".join(lines)


# --- settings -----------------------------------------------------------------------------


def _pairs(scan: Scan, config: Config) -> Choice:
    count, wanted = len(scan.photos), config.matches.pairs
    if wanted != "auto":
        return wanted, f"{wanted} pairs, as configured"
    if count <= EXHAUSTIVE_PHOTOS:
        return (
            "exhaustive",
            f"exhaustive pairs: all {count * (count - 1) // 2} of {count} photographs",
        )
    metres = _gps_extent(scan)
    if scan.num_gps >= SPATIAL_SHARE * count and metres >= SPATIAL_METRES:
        return "spatial", f"spatial pairs: GPS in {scan.num_gps} of {count}, {metres:.0f} m across"
    if scan.ordered is not None:
        return "sequential", f"sequential pairs: {count} photographs, {scan.ordered}"
    return (
        "retrieval",
        f"retrieval pairs: {count} photographs are too many for all pairs, and neither order nor "
        "GPS sorts them",
    )


def _gps_extent(scan: Scan) -> float:
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


def _keypoints(scan: Scan, config: Config) -> str:
    features = config.features
    longest = min(max(max(size) for size in scan.sizes), features.max_long_side_px)
    return (
        f"up to {features.max_features} SIFT keypoints each ({features.backend}), at {longest} px"
    )


def _mapper(config: Config) -> Choice:
    wanted = config.sfm.mapper
    if wanted != "auto":
        return wanted, f"{wanted} mapper, as configured"
    # Its time grows with the photographs as such, the global one's with their square (docs/sfm.md).
    return "incremental", "incremental mapper; the global one where its model is not good"


def _camera_model(scan: Scan, config: Config) -> Choice:
    wanted = config.sfm.camera_model
    priors = f"focal length from EXIF in {scan.num_focal} of {len(scan.photos)} photographs"
    if wanted != "auto":
        return wanted, f"{wanted} cameras, as configured; {priors}"
    if any("fisheye" in photo.camera_group.casefold() for photo in scan.photos):
        return "OPENCV_FISHEYE", f"OPENCV_FISHEYE cameras: EXIF names a fisheye lens; {priors}"
    return "SIMPLE_RADIAL", f"SIMPLE_RADIAL cameras; {priors}"


def _frame(scan: Scan, config: Config) -> str:
    wanted, control = config.sfm.georeference, scan.ground_control is not None
    if wanted in ("auto", "gcp") and control:
        return "the scene's frame from the ground control points in gcp_list.txt"
    if wanted in ("auto", "gps") and scan.num_gps:
        return f"the scene's frame from GPS in {scan.num_gps} photographs, if it says enough"
    ignored = ", as configured" if wanted == "none" else ": neither GPS nor ground control points"
    return f"the scene's frame level and of unit size{ignored}"


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


def _settled(config: Config, changes: Mapping[str, Mapping[str, Any]]) -> Config:
    sections = {
        name: getattr(config, name).model_copy(update=dict(values))
        for name, values in changes.items()
    }
    return Config.model_validate(config.model_copy(update=sections).model_dump())


# --- stages -------------------------------------------------------------------------------


def _decode(scan: Scan, config: Config) -> StagePlan:
    if scan.num_raw == 0:
        return StagePlan(run=False, reason="no RAW files: the photographs are read as they are")
    depth = "16-bit linear" if config.decode.linear else "8-bit sRGB"
    half = ", half size" if config.decode.half_size else ""
    return StagePlan(
        run=True,
        reason=f"{scan.num_raw} of {len(scan.photos)} photographs are RAW",
        decisions=[
            f"{depth}, {config.decode.demosaic} demosaicking{half}, one white balance "
            f"({config.decode.white_balance}) for all"
        ],
    )


def _given(poses: GivenPoses) -> str:
    where = "transforms*.json" if poses.path == "." else poses.path
    return f"poses are given: {_POSE_KINDS[poses.kind]} {where}, {poses.num_images} cameras"


def _pose_stage(poses: GivenPoses | None, reason: str, decisions: list[str]) -> StagePlan:
    if poses is not None:
        return StagePlan(run=False, reason=_given(poses))
    return StagePlan(run=True, reason=reason, decisions=decisions)


def _why_sfm(config: Config) -> str:
    ignored = config.poses == "ignore"
    return (
        "poses are found anew, as configured (poses: ignore)" if ignored else "no poses are given"
    )


def _refine(scan: Scan, config: Config) -> StagePlan:
    """Whether given poses are adjusted to their own tracks."""
    poses, freed = scan.poses, config.sfm.refine_principal_point
    if poses is None:
        return StagePlan(run=False, reason="no poses are given; sfm adjusts its own")
    if config.poses == "keep":
        return StagePlan(run=False, reason="the given poses are kept, as configured (poses: keep)")
    if freed == "no":
        return StagePlan(run=False, reason="principal points are held, as configured")
    if poses.tracked < MIN_TRACKED:
        few = f"a photograph with {poses.tracked} tracked points" if poses.tracked else "no tracks"
        return StagePlan(run=False, reason=f"the given poses come with {few} to adjust them to")
    if not poses.centred and freed != "yes":
        text = f"no camera of {SHARED_BY} photographs has its principal point exactly in the middle"
        return StagePlan(run=False, reason=text)
    return StagePlan(
        run=True,
        reason="the given principal points stand in the middle, where nobody looked for them"
        if poses.centred
        else "principal points are freed, as configured",
        decisions=["poses, points and lenses adjusted to the given tracks, where that pays"],
    )


def _undistort(scan: Scan, config: Config) -> StagePlan:
    if scan.poses is not None:
        models = ", ".join(scan.poses.models)
        if scan.poses.pinhole:
            return StagePlan(run=False, reason=f"the given cameras are pinhole already ({models})")
        return StagePlan(run=True, reason=f"the given cameras distort ({models})")
    model = config.sfm.camera_model
    if model in ("PINHOLE", "SIMPLE_PINHOLE"):
        return StagePlan(run=False, reason=f"{model} cameras do not distort")
    return StagePlan(run=True, reason=f"{model} cameras distort")


def _init(scan: Scan, config: Config) -> StagePlan:
    if config.init.method == "random":
        return StagePlan(run=True, reason=f"{config.init.num_random} random Gaussians")
    if scan.poses is None:
        return StagePlan(run=True, reason="Gaussians from the sparse points of sfm")
    if scan.poses.num_points:
        points = f"{scan.poses.num_points} sparse points"
        return StagePlan(run=True, reason=f"Gaussians from the given {points}")
    return StagePlan(
        run=True,
        reason="Gaussians from points triangulated at the given poses, which came without any",
        decisions=["pairs of cameras that stand close and look alike"],
    )


def _length(config: Config) -> str:
    minutes = config.train.budget_minutes
    return f"{config.train.steps} steps" if minutes is None else f"{minutes:g} minutes"


def _resolution(scan: Scan, config: Config) -> str:
    (width, height), *others = scan.sizes
    cap = config.views.max_long_side_px
    small_width, small_height = view_size(width, height, cap)
    share = small_width / width
    text = f"views of {small_width}x{small_height} pixels, {share:.3g} of the photographs"
    if (small_width, small_height) == (width, height):
        text = f"views of {width}x{height} pixels, as photographed"
    if others:
        text += f" (the commonest of {len(others) + 1} sizes; none above {cap} px)"
    return text


def _mask_lines(scan: Scan, config: Config) -> list[str]:
    if config.views.masks == "ignore":
        return ["masks ignored, as configured"]
    return [f"masks in {scan.num_masks} photographs"] if scan.num_masks else []


def _split(config: Config) -> str:
    every = config.split.holdout_every
    if every == 0:
        return "no view is held out: measured on the training views"
    return f"one view in {every}, sorted by name, is held out"


def _truth(scan: Scan) -> list[str]:
    return ["pose error against the truth in sparse_gt/"] if scan.truth is not None else []


def _some(warnings: Sequence[str]) -> list[str]:
    """The first warnings, and how many more there are; the inspect stage keeps them all."""
    rest = len(warnings) - FACTS_SHOWN
    return [*warnings[:FACTS_SHOWN], *([f"and {rest} more like these"] if rest > 0 else [])]


def _commonest(counts: Counter[str]) -> dict[str, int]:
    """The commonest and their counts; the rest together."""
    ordered = sorted(counts.items(), key=lambda item: (-item[1], item[0]))
    rest = sum(count for _, count in ordered[FACTS_SHOWN:])
    return dict(ordered[:FACTS_SHOWN]) | ({"others": rest} if rest else {})


def _facts(scan: Scan, config: Config) -> dict[str, Any]:
    photos = scan.photos
    width, height = view_size(*scan.sizes[0], config.views.max_long_side_px)
    sizes = Counter(f"{photo.width}x{photo.height}" for photo in photos)
    groups = Counter(photo.camera_group for photo in photos)
    return {
        "photographs": len(photos),
        "raw": scan.num_raw,
        "alpha": scan.num_alpha,
        "masks": scan.num_masks,
        "depths": scan.num_depths,
        "gps": scan.num_gps,
        "ground_control": scan.ground_control is not None,
        "gps_extent_m": round(_gps_extent(scan), 1),
        "focal_priors": scan.num_focal,
        "turned_by_exif": sum(photo.orientation != 1 for photo in photos),
        "bits": max(photo.bits for photo in photos),
        "sizes": _commonest(sizes),
        "camera_groups": _commonest(groups),
        "ordered": scan.ordered,
        "image_folder": scan.image_folder,
        "view_size": [width, height],
        "training_memory_mb": training_memory_mb(scan, config),
        "given_poses": None
        if scan.poses is None
        else scan.poses.model_dump(mode="json", exclude={"names"}),
        "truth": "sparse_gt" if scan.truth is not None else None,
        "truth_digest": scan.truth_digest,
        "fingerprint": scan.fingerprint,
    }
