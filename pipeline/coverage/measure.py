"""Coverage of a trained scene by its photographs: ``coverage.json`` and its images."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from pipeline.coverage.contradictions import (
    compare_novel_views,
    contradiction_map,
    find_contradictions,
)
from pipeline.coverage.defects import floating, holes, near_floaters
from pipeline.coverage.probe_views import (
    Bools,
    Doubles,
    Floats,
    ProbeView,
    Renderer,
    render_probes,
)
from pipeline.coverage.record import (
    CoverageRecord,
    ErrorByTrust,
    ErrorClass,
    FloaterCoverage,
    NovelKind,
    NovelPlace,
    NovelViewCoverage,
    ProposedViewpoint,
    SeenBy,
    SurfaceCoverage,
    Surroundings,
    ViewCoverage,
)
from pipeline.coverage.summary import describe
from pipeline.coverage.training_views import (
    MAX_TRAINING_VIEWS,
    SurfaceSample,
    TrainingViews,
    render_training_views,
)
from pipeline.coverage.trust import LOW_TRUST, trust_maps
from pipeline.coverage.viewpoints import NextBestViews, propose_viewpoints
from pipeline.metrics.evaluation import Evaluation
from pipeline.metrics.protocol import Protocol
from pipeline.photos.load import load_view, resize_area
from pipeline.render import RasterOptions
from pipeline.render.views import Render, render_view, to_bytes
from pipeline.runtime.atomic import write_bytes
from pipeline.runtime.progress import track
from pipeline.scene.georeference import Georeference
from pipeline.scene.manifest import Manifest
from pipeline.scene.normalization import IDENTITY, Normalization
from pipeline.scene.views import View, evenly_spaced, scene_up
from pipeline.splats.gaussians import Gaussians

#: Largest number of test views. Larger sets are sampled evenly.
MAX_TEST_VIEWS = 12
#: Number of test views, those of least trust, whose images are written.
SHOWN = 2
#: Error and trust are averaged over square blocks of the maps; side in pixels.
BLOCK = 8
#: The rank correlation is not computed for fewer blocks.
MIN_BLOCKS = 50
#: Bounds of the classes of trust whose errors are reported.
CLASSES = (0.0, 0.25, 0.5, 0.75, 1.0)
#: Part of ``coverage.json``.
FORMULA = (
    "precision (how far a point may be off in this view, by triangulation from the photographs "
    "that see it) times support (how near in direction, and how sharp, the nearest is); 0 to 1"
)


@dataclass(frozen=True)
class MeasuredView:
    """A test view with its trust and its error.

    Attributes:
        trust: (H, W), in [0, 1].
        squared_error: (H, W) mean over the channels, for colours in [0, 1].
        measured: (H, W) True in the pixels that are measured.
        record: The view's entry in ``coverage.json``.
    """

    probe: ProbeView
    trust: Floats
    squared_error: Floats
    measured: Bools
    record: ViewCoverage


class Images(NamedTuple):
    """Files of a render and of its trust map, relative to the stage's folder."""

    render: str
    trust_map: str


@dataclass(frozen=True)
class WorldFrame:
    """The world frame of the views.

    Attributes:
        up: (3,) unit vector.
        unit: The name of the unit of length; None if the scale is arbitrary.
        normalization: The transform from the world of the given poses, in which results are
            recorded, to that of the views.
    """

    up: Doubles
    unit: str | None
    normalization: Normalization = IDENTITY

    @property
    def digits(self) -> int:
        """Further decimals of recorded lengths, if the given unit is large."""
        return max(0, round(np.log10(self.normalization.scale)))


def world_frame(
    views: Sequence[View], manifest: Manifest, georeference: Georeference | None
) -> WorldFrame:
    """The world frame: ``up`` from the orientation of the photographs, ``unit`` from the
    georeference, None for given poses in their own world."""
    up = scene_up(views, manifest)
    if georeference is None:
        return WorldFrame(up, None)
    unit = "m" if georeference.is_metric else None
    return WorldFrame(up, unit, georeference.normalization)


def measure_coverage(
    out: Path,
    gaussians: Gaussians,
    views: Sequence[View],
    protocol: Protocol,
    options: RasterOptions,
    evaluation: Evaluation,
    renders: Path,
    world: WorldFrame,
) -> CoverageRecord:
    """Write ``coverage.json`` and ``coverage/*.png`` into the folder ``out``.

    Args:
        views: All views with a pose.
        options: How views are rendered. The number of threads does not affect results.
        evaluation: The result of ``evaluate_views``.
        renders: The folder of the renders that ``evaluation`` names.

    Returns:
        The content of ``coverage.json``.
    """
    threads = options.threads

    def render(view: View) -> Render:
        return render_view(gaussians, view, options)

    num_training = sum(not view.is_test for view in views)
    record = CoverageRecord(
        num_training_views=num_training,
        num_rendered_views=min(num_training, MAX_TRAINING_VIEWS),
        trust_definition=FORMULA,
    )
    training = render_training_views(views, render)
    if training is None:
        record = record.model_copy(update={"reason": "the scene shows no surface"})
        record.write(out)
        return record
    probes, background_depth = training.probes, training.background_depth
    nearest = training.surface.nearest
    tested = _measure_test_views(
        evaluation, renders, protocol, probes, render, background_depth, nearest, threads
    )
    # Photographs of test views exist as well: proposals must not repeat them.
    all_probes = [*probes, *(item.probe for item in tested)]
    cameras = [*training.views, *(_named(views, item.probe.view.name) for item in tested)]
    best = propose_viewpoints(cameras, all_probes, render, world.up, background_depth)
    floaters = near_floaters(gaussians, probes, all_probes[len(probes) :], nearest)
    shown = sorted(
        (item for item in tested if item.record.mean_trust is not None),
        key=lambda item: item.record.mean_trust or 0.0,
    )[:SHOWN]
    images = {
        item.record.name: _write_images(out, f"view_{i + 1}", item.probe, item.trust)
        for i, item in enumerate(shown)
    }
    record = record.model_copy(
        update={
            "surface": _surface(training.surface),
            "views": tuple(_with_images(item.record, images) for item in tested),
            "error": _error_by_trust(tested),
            "floaters": FloaterCoverage(
                num_gaussians=floaters.count,
                search_distance=floaters.within / world.normalization.scale,
                by_camera=floaters.cameras,
            ),
            "novel_views": _novel_views(out, training, gaussians, options, world),
            "surroundings": Surroundings(
                num_viewpoints=len(best.candidates),
                mean_trust=best.trust_before,
                mean_trust_with_proposals=best.trust_after,
            ),
            "viewpoints": _proposals(out, best, all_probes, world, background_depth, threads),
        }
    )
    record.write(out)
    return record


def _with_images(record: ViewCoverage, images: Mapping[str, Images]) -> ViewCoverage:
    found = images.get(record.name)
    return record if found is None else record.model_copy(update=found._asdict())


def _named(views: Sequence[View], name: str) -> View:
    return next(view for view in views if view.name == name)


def _surface(sample: SurfaceSample) -> SurfaceCoverage | None:
    if not len(sample.count):
        return None
    count = sample.count
    seen_by = SeenBy(
        one=_share(count == 1), two=_share(count == 2), three_or_more=_share(count > 2)
    )
    return SurfaceCoverage(
        seen_by=seen_by,
        median_photographs=float(np.median(count)),
        median_parallax_deg=_rounded(np.median(sample.parallax)),
    )


def _measure_test_views(
    evaluation: Evaluation,
    renders: Path,
    protocol: Protocol,
    probes: Sequence[ProbeView],
    render: Renderer,
    background_depth: float,
    nearest: float,
    threads: int,
) -> list[MeasuredView]:
    by_name = {view.name: view for view in protocol.views if view.is_test}
    items = evenly_spaced(
        [item for item in evaluation.per_view if item.name in by_name], MAX_TEST_VIEWS
    )
    views = [by_name[item.name] for item in items]
    test_probes = list(render_probes(views, render))
    maps = trust_maps(test_probes, probes, background_depth, threads)
    maps = track(maps, "mapping trust", len(items), unit="views")
    result = []
    for item, view, probe, (trust, observed) in zip(items, views, test_probes, maps, strict=True):
        pixels = load_view(view)
        photo = pixels.over(protocol.background)
        with Image.open(renders / item.render) as image:
            error = ((np.asarray(image) / 255.0 - photo / 255.0) ** 2).mean(axis=2)
        height, width = probe.depth.shape
        opaque, measured = None, probe.valid
        if pixels.alpha is not None:
            opaque = resize_area(pixels.alpha, width, height) > 127
            measured = measured & (opaque | ~probe.empty)
        record = ViewCoverage(
            name=view.name,
            psnr=item.psnr,
            mean_trust=_rounded(trust[measured].mean()) if measured.any() else None,
            low_trust_share=_share(trust[measured] < LOW_TRUST),
            hole_share=_share(holes(probe, observed, opaque)[measured]),
            floater_share=_share(floating(probe, observed, nearest)[measured]),
            median_photographs=float(np.median(observed.count)),
        )
        small = resize_area(error.astype(np.float32), width, height)
        result.append(MeasuredView(probe, trust, small, measured, record))
    return result


def _error_by_trust(tested: Sequence[MeasuredView]) -> ErrorByTrust:
    """How the error of test views depends on trust: Spearman's rank correlation over blocks, and
    the RMS error in classes of trust."""
    pairs = [_blocks(item) for item in tested]
    trust, error = (
        np.concatenate([pair[i] for pair in pairs]) if pairs else np.zeros(0) for i in (0, 1)
    )
    classes = np.digitize(trust, CLASSES[1:-1])
    undefined = len(trust) < MIN_BLOCKS or np.ptp(trust) == 0 or np.ptp(error) == 0
    return ErrorByTrust(
        num_blocks=len(trust),
        block_px=BLOCK,
        rank_correlation=None if undefined else _rounded(spearman(trust, error)),
        by_trust=tuple(
            ErrorClass(
                trust_range=(low, high),
                share=_share(classes == i),
                rmse=_rounded(np.sqrt(error[classes == i].mean()), 4),
            )
            for i, (low, high) in enumerate(pairwise(CLASSES))
            if (classes == i).any()
        ),
    )


def spearman(first: Doubles, second: Doubles) -> float:
    """Spearman's rank correlation of two (N,) arrays; equal values have the mean of their ranks.

    As ``scipy.stats.spearmanr``, which takes longer to import than all of coverage takes.
    """
    return float(np.corrcoef(_ranks(first), _ranks(second))[0, 1])


def _ranks(values: Doubles) -> Doubles:
    _, inverse, counts = np.unique(values, return_inverse=True, return_counts=True)
    return (np.cumsum(counts) - (counts - 1) / 2)[inverse]


def _blocks(item: MeasuredView) -> tuple[NDArray[Any], NDArray[Any]]:
    """Mean trust and mean squared error of the blocks with at least half of the pixels measured."""
    height, width = (side // BLOCK * BLOCK for side in item.measured.shape)

    def total(values: NDArray[Any]) -> Doubles:
        blocks = values[:height, :width].astype(np.float64)
        return blocks.reshape(height // BLOCK, BLOCK, width // BLOCK, BLOCK).sum(axis=(1, 3))

    number = total(item.measured)
    enough = number >= BLOCK * BLOCK / 2
    return tuple(  # type: ignore[return-value]
        total(values * item.measured)[enough] / number[enough]
        for values in (item.trust, item.squared_error)
    )


def _proposals(
    out: Path,
    best: NextBestViews,
    probes: Sequence[ProbeView],
    world: WorldFrame,
    background_depth: float,
    threads: int,
) -> tuple[ProposedViewpoint, ...]:
    """The proposals, with their images written."""
    missing = max(1 - best.trust_before, 1e-9)
    shown = [proposal.probe for proposal in best.proposals]
    maps = trust_maps(shown, probes, background_depth, threads)
    found = []
    for i, (proposal, (trust, _)) in enumerate(zip(best.proposals, maps, strict=True)):
        view = world.normalization.view_to_given(proposal.viewpoint.view)
        subject = world.normalization.to_given(np.asarray(proposal.viewpoint.subject))
        digits = 6 + world.digits
        images = _write_images(out, f"next_{i + 1}", proposal.probe, trust)
        found.append(
            ProposedViewpoint(
                description=describe(proposal.viewpoint, probes, world.up, world.unit),
                position=_rounded(view.centre, digits),
                direction=_rounded(view.world_to_camera[2, :3], 6),
                look_at=_rounded(subject, digits),
                world_to_camera=_rounded(view.world_to_camera, digits + 3),
                unknown_percent=_rounded(100 * proposal.unknown, 1),
                gain_percent=_rounded(100 * proposal.gain / missing, 1),
                render=images.render,
                trust_map=images.trust_map,
            )
        )
    return tuple(found)


def _novel_views(
    out: Path,
    training: TrainingViews,
    gaussians: Gaussians,
    options: RasterOptions,
    world: WorldFrame,
) -> NovelViewCoverage | None:
    """The novel views, with the images of the worst one written; None without any."""
    background, threads = options.background, options.threads
    found = compare_novel_views(training, world.up, gaussians, options)
    if found is None:
        return None
    worst = int(found.shares[:, 0].argmax())
    novel, shown = found.views[worst], found.probes[worst]
    (contradictions,) = find_contradictions([shown], training, background, threads)
    names = "coverage/novel_render.png", "coverage/novel_map.png"
    _write_pngs(out, names, (shown.probe.rgb, contradiction_map(shown.probe, contradictions)))
    by_kind: dict[str, NovelKind] = {
        kind: NovelKind(num_views=number, **_shares(shares))
        for kind, (number, shares) in found.by_kind().items()
    }
    view = world.normalization.view_to_given(novel.view)
    place = NovelPlace(
        kind=novel.kind,
        near=novel.base.name,
        **_shares(found.shares[worst]),
        world_to_camera=_rounded(view.world_to_camera, 9 + world.digits),
        render=names[0],
        map=names[1],
    )
    return NovelViewCoverage(**_shares(found.shares.mean(axis=0)), by_kind=by_kind, worst=place)


def _shares(values: Doubles) -> dict[str, Any]:
    contradicted, unseen = _rounded(values, 4)
    return {"contradicted_share": contradicted, "unseen_share": unseen}


def _write_images(out: Path, name: str, probe: ProbeView, trust: Floats) -> Images:
    """Write the render and the trust map (grey, white is 1) of a probe view."""
    files = Images(f"coverage/{name}_render.png", f"coverage/{name}_trust.png")
    _write_pngs(out, files, (probe.rgb, to_bytes(trust)))
    return files


def _write_pngs(out: Path, files: Sequence[str], pictures: Sequence[NDArray[np.uint8]]) -> None:
    for file, picture in zip(files, pictures, strict=True):
        buffer = io.BytesIO()
        Image.fromarray(picture).save(buffer, "PNG")
        write_bytes(out / file, buffer.getvalue())


def _share(condition: NDArray[Any]) -> float:
    return round(float(condition.mean()), 4) if condition.size else 0.0


def _rounded(values: Any, digits: int = 3) -> Any:
    return np.round(np.asarray(values, np.float64), digits).tolist()
