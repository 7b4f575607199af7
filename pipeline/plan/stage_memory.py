"""Estimates of the stages' memory, which clusters reserve for their jobs.

They are fitted to the peaks in the ``run.json`` of scenes of 20 to 128 photographs of up to
20 megapixels.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

from pipeline.config.export import (
    LOSSY_FORMATS,
    MAX_MEASURED_LOSSES,
    MAX_TEXTURE_PX,
    RENDERED_FORMATS,
    SURVEY_FORMATS,
)
from pipeline.config.schema import MAX_PHOTOS_WITH_MORE_FEATURES, MORE_FEATURES
from pipeline.plan.training_memory import GAUSSIAN_BYTES, MEMORY_MARGIN, block_mb, coarse_mb
from pipeline.plan.values import Plan
from pipeline.scene.views import view_size

# MB of a process of Python with numpy and OpenCV or pycolmap; with numpy alone; with torch; with
# torch and the rasterizer's kernels.
_PROGRAM, _NUMPY, _TORCH, _RASTERIZER = 140.0, 70.0, 270.0, 290.0
# Bytes per pixel of a photograph in one thread: decoded and reduced; scanned; undistorted;
# developed by LibRaw. The last value is the bytes per pixel of SIFT's scale space.
_DECODED, _SCANNED, _UNDISTORTED, _DEVELOPED, _SCALE_SPACE = 3.2, 5.5, 9.5, 30.0, 195.0
# Bytes per pixel of a panorama for the maps of its views, which all threads share.
_VIEW_MAPS = 15.0
# MB per photograph of features and matches, and of the mapper's model, both for 3000 features.
_MATCHES, _MAPPING, _FEATURES = 0.95, 1.7, 3000
# Bytes per Gaussian that is held; that is held and rendered; that is rendered with gradients; that
# is held, read again from a compressed file and rendered.
_HELD, _RENDERED, _PARTITIONED, _READ_AGAIN = 250.0, 400.0, 720.0, 1250.0
# MB for the levels of detail of a chunk, at its largest number of Gaussians.
_LEVELS, _CHUNK = 260.0, 1 << 17
# Bytes per pixel of a rendered view; of a view measured in one thread. MB of a thread's band.
_IMAGE, _MEASURED, _BAND = 60.0, 50.0, 12.0
# MB of the report's page with its parts, and of a mesh.
_PAGE, _MESH = 110.0, 450.0
# Bytes per pixel of a mesh's texture, which has no more pixels than the photographs.
_TEXEL = 80.0
# MB per photograph of a sparse model that is read; read with views; written; copied.
_MODEL_READ, _MODEL_VIEWS, _MODEL_WRITTEN, _MODEL_COPIED = 0.1, 0.5, 0.45, 0.6
# Bytes per pixel of a view in multi-view stereo: matched in a thread; fused in a thread; of the
# views that are cached.
_STEREO, _FUSION, _CACHED_VIEWS = 320.0, 150.0, 170.0
# The points of the fused cloud as a share of the pixels, and their maximum in millions. Bytes of a
# point, and of a point of the sample that is thinned.
_FUSED_SHARE, _MAX_FUSED, _FUSED, _SAMPLED = 0.25, 5.0, 30.0, 150.0
# Bytes of a point of the fused cloud in a map, and per pixel of the photographs that are cached.
_MAPPED, _CACHED_PHOTOS = 220.0, 60.0
# The number of photographs whose features are in memory at a time while pairs are matched; MB per
# photograph of the list of pairs; MB of the comparison of photographs by which pairs are chosen.
_KEYPOINT_FILES, _LISTED, _COMPARED = 200, 0.03, 80

Estimate = Callable[[Plan, int], float]


def memory_mb(stage: str, plan: Plan, threads: int) -> int:
    """The memory in MB that the stage's job may use: the configured value, else the estimate with a
    margin."""
    needed, most = _needed(stage, plan, threads), plan.config.partition.memory_mb
    return needed if most is None else min(needed, most)


def memory_warnings(plan: Plan) -> list[str]:
    """A warning if a stage that runs needs more than ``partition.memory_mb`` with one thread."""
    most = plan.config.partition.memory_mb
    if most is None:
        return []
    running = [name for name in _ESTIMATES if name in plan.stages and plan.runs(name)]
    needed = {name: math.ceil(_ESTIMATES[name](plan, 1)) for name in running}
    above = {name: megabytes for name, megabytes in needed.items() if megabytes > most}
    if not above:
        return []
    largest = max(above, key=lambda name: above[name])
    return [
        f"partition.memory_mb: {most} MB may not be enough for {', '.join(above)}; {largest} is "
        f"estimated to take {above[largest]} MB with one thread. Increase it, or lower "
        "views.max_long_side_px and features.max_features"
    ]


def threads_within(stage: str, plan: Plan, threads: int) -> int:
    """The number of threads, at most ``threads``, for which ``partition.memory_mb`` is enough."""
    most = plan.config.partition.memory_mb
    if most is None:
        return threads
    fitting = (n for n in range(threads, 1, -1) if _needed(stage, plan, n) <= most)
    return next(fitting, 1)


def _needed(stage: str, plan: Plan, threads: int) -> int:
    return math.ceil(MEMORY_MARGIN * _ESTIMATES[stage](plan, threads))


def _largest(plan: Plan) -> tuple[int, int]:
    """The width and height of the largest photographs among the most frequent sizes."""
    sizes = [tuple(map(int, size.split("x"))) for size in plan.facts.sizes if size != "others"]
    width, height = max(sizes, key=lambda size: size[0] * size[1], default=(0, 0))
    return width, height


def _pixels(plan: Plan) -> float:
    """The megapixels of the largest photographs."""
    width, height = _largest(plan)
    return width * height / 1e6


def _view_pixels(plan: Plan) -> float:
    """The megapixels of a view."""
    width, height = plan.facts.view_size
    return width * height / 1e6


def _photos(plan: Plan) -> int:
    return plan.facts.photographs + plan.facts.max_frames


def _gaussians(plan: Plan) -> float:
    """The largest number of trained Gaussians in millions. Views show several blocks, each of which
    has fewer Gaussians than the whole scene as one block."""
    blocks = int(plan.config.partition.blocks)
    return plan.config.train.density.max_gaussians * (1 + blocks) / 2 / 1e6


def _with_model(plan: Plan) -> float:
    """The memory of a program that copies the given poses with their points, if there are any."""
    poses = plan.facts.given_poses
    if poses is None or not poses.num_points:
        return _PROGRAM
    return max(_PROGRAM, _NUMPY + 10 + _MODEL_COPIED * _photos(plan))


def _inspect(plan: Plan, threads: int) -> float:
    return _with_model(plan) + threads * _SCANNED * _pixels(plan)


def _decode(plan: Plan, threads: int) -> float:
    return _PROGRAM + threads * (_DEVELOPED if plan.facts.linear else _SCANNED) * _pixels(plan)


def _features(plan: Plan, threads: int) -> float:
    reduced = view_size(*_largest(plan), plan.config.features.max_long_side_px)
    scale_space = _SCALE_SPACE * reduced[0] * reduced[1] / 1e6
    return _PROGRAM + threads * (scale_space + _DECODED * _pixels(plan))


def _mapping(plan: Plan, threads: int) -> float:
    return _PROGRAM + 25 + _MAPPING * _feature_share(plan) * _photos(plan)


def _feature_share(plan: Plan) -> float:
    """The number of features of a photograph, relative to that of the estimates. A second look
    raises the number."""
    most = plan.config.features.max_features
    if _photos(plan) <= MAX_PHOTOS_WITH_MORE_FEATURES:
        most = max(most, MORE_FEATURES)
    return most / _FEATURES


def _gathered_features(plan: Plan, threads: int) -> float:
    return _features(plan, threads) if plan.is_one_job else _PROGRAM + 10


def _pairs(plan: Plan, threads: int) -> float:
    return _gathered_matches(plan) + _COMPARED


def _matches(plan: Plan, threads: int) -> float:
    if not plan.is_one_job:
        return _gathered_matches(plan)
    # A second look extracts more features in a process beside this one, and then matches them.
    looked = _gathered_matches(plan) + _features(plan, threads)
    return max(looked, _matching(plan, _feature_share(plan)))


def _gathered_matches(plan: Plan) -> float:
    return _PROGRAM + 25 + _LISTED * _photos(plan)


def _match(plan: Plan, threads: int) -> float:
    return _matching(plan, plan.config.features.max_features / _FEATURES)


def _matching(plan: Plan, feature_share: float) -> float:
    """The memory of matching, which holds the features of a limited number of photographs."""
    in_memory = min(plan.photos_per_job, _KEYPOINT_FILES)
    return _gathered_matches(plan) + _MATCHES * feature_share * in_memory


def _undistort(plan: Plan, threads: int) -> float:
    maps = _VIEW_MAPS * _pixels(plan) if plan.facts.panoramas else 0.0
    return _with_model(plan) + maps + threads * _UNDISTORTED * _pixels(plan)


def _dense(plan: Plan, threads: int) -> float:
    pixels = _view_pixels(plan)
    # Fusion holds the parts of the cloud, and the whole.
    fusion = (threads * _FUSION + _CACHED_VIEWS) * pixels + 2 * _FUSED * _fused_points(plan)
    decoded = threads * _DECODED * _pixels(plan)
    work = max(threads * _STEREO * pixels, fusion)
    return _PROGRAM + _MODEL_READ * _photos(plan) + decoded + work


def _fused_points(plan: Plan) -> float:
    """The number of points of the fused cloud in millions."""
    return min(_FUSED_SHARE * _photos(plan) * _view_pixels(plan), _MAX_FUSED)


def _init(plan: Plan, threads: int) -> float:
    poses = plan.facts.given_poses
    triangulated = poses is not None and not poses.num_points
    if plan.config.init.method == "dense":
        sample = min(5 * plan.config.init.max_points / 1e6, _fused_points(plan))
        return _PROGRAM + 10 + _FUSED * _fused_points(plan) + _SAMPLED * sample
    return max(_features(plan, threads), _mapping(plan, threads)) if triangulated else _PROGRAM + 10


def _train(plan: Plan, threads: int) -> float:
    if plan.config.partition.blocks == 1:
        return plan.facts.training_memory_mb
    # Uniting the blocks holds one of them at a time.
    return _NUMPY + _HELD * plan.config.train.density.max_gaussians / 1e6


def _trained(plan: Plan) -> tuple[int, int]:
    """The pixels of a view, and the maximum number of Gaussians of the scene."""
    width, height = plan.facts.view_size
    return width * height, plan.config.train.density.max_gaussians


def _block(plan: Plan, threads: int) -> float:
    return block_mb(*_trained(plan), int(plan.config.partition.blocks))


def _evaluate(plan: Plan, threads: int) -> float:
    pixels = _view_pixels(plan)
    measured = threads * (_BAND + _MEASURED * pixels)
    drawn = _RENDERED * _gaussians(plan) + _IMAGE * pixels
    return _RASTERIZER + _MODEL_VIEWS * _photos(plan) + drawn + measured


def _coverage(plan: Plan, threads: int) -> float:
    return _RASTERIZER + 25 + _MODEL_VIEWS * _photos(plan) + _RENDERED * _gaussians(plan)


def _holes(plan: Plan, threads: int) -> float:
    # Each painted view is rendered and differentiated with as many invented Gaussians again.
    return _coverage(plan, threads) + 2 * _PARTITIONED * _gaussians(plan)


def _export(plan: Plan, threads: int) -> float:
    written = _NUMPY + _MODEL_WRITTEN * _photos(plan) + _HELD * _gaussians(plan)
    export = plan.config.export
    rendered = RENDERED_FORMATS.intersection(export.formats)
    selected = export.max_gaussians is not None or export.region is not None
    if not {"sog_lod", "tiles3d"}.isdisjoint(export.formats):
        written += _LEVELS * min(1.0, 1e6 * _gaussians(plan) / _CHUNK)
    if not SURVEY_FORMATS.isdisjoint(export.formats):
        written += _MAPPED * _fused_points(plan) + _CACHED_PHOTOS * _pixels(plan)
    needed = [written]
    if not set(LOSSY_FORMATS).isdisjoint(export.formats):
        read = _READ_AGAIN * min(_gaussians(plan), MAX_MEASURED_LOSSES / 1e6)
        needed.append(
            _RASTERIZER + _MODEL_VIEWS * _photos(plan) + _IMAGE * _view_pixels(plan) + read
        )
    if rendered or selected:
        drawn = _evaluate(plan, threads) + _PARTITIONED * _gaussians(plan) * selected
        if export.max_gaussians is not None:
            # They are refined, as in training.
            drawn += GAUSSIAN_BYTES * min(export.max_gaussians / 1e6, _gaussians(plan))
        texels = min(
            (export.texture_px or MAX_TEXTURE_PX) ** 2 / 1e6, _photos(plan) * _view_pixels(plan)
        )
        needed.append(drawn + (_MESH + _TEXEL * texels) * ("mesh" in rendered))
    return max(needed)


def _report(plan: Plan, threads: int) -> float:
    return _NUMPY + _PAGE + _MODEL_READ * _photos(plan) + _HELD * _gaussians(plan)


_ESTIMATES: Mapping[str, Estimate] = {
    "inspect": _inspect,
    "decode": _decode,
    "extract": _features,
    "features": _gathered_features,
    "pairs": _pairs,
    "match": _match,
    "matches": _matches,
    "sfm": _mapping,
    "refine": _mapping,
    "undistort": _undistort,
    "dense": _dense,
    "init": _init,
    "coarse": lambda plan, threads: coarse_mb(*_trained(plan)),
    "partition": lambda plan, threads: _TORCH + _PARTITIONED * _gaussians(plan),
    "block": _block,
    "polish": _block,
    "train": _train,
    "holes": _holes,
    "evaluate": _evaluate,
    "coverage": _coverage,
    "export": _export,
    "report": _report,
}
