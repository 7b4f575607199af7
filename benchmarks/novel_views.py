"""What finished scenes show beside their photographs: floaters, veils and haze.

    python -m benchmarks.novel_views results/fox results/fox@new
    python -m benchmarks.novel_views results/fox --against results/fox@seed1

Each scene's model is compared with its photographs in novel views (``coverage.contradictions``).
With ``--against``, the same views are rendered with another model of the same photographs as well,
such as one of another seed or of other training views: where two models differ, at least one is
wrong, and no photograph is needed. PSNR and SSIM are between the two renders.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.measured import add_record_options, measured, write_record
from benchmarks.record_tables import novel_views
from benchmarks.results import NovelViewResult
from pipeline.coverage.contradictions import NovelViews, compare_novel_views
from pipeline.coverage.probe_views import reduced
from pipeline.coverage.training_views import render_training_views
from pipeline.geometry.similarity import Similarity
from pipeline.io.npz import read_npz
from pipeline.metrics.image import psnr, ssim
from pipeline.metrics.pose import align_poses
from pipeline.metrics.protocol import choose_protocol
from pipeline.plan.posed_scene import posed_scene
from pipeline.render import RasterOptions
from pipeline.render.views import render_rgb, render_view
from pipeline.runtime.errors import EXIT_USER_ERROR, UserError
from pipeline.runtime.machine import usable_cores
from pipeline.scene.views import View
from pipeline.splats.gaussians import Gaussians

#: Longer side of the renders that are compared with another model's, pixels.
SIDE = 512
MIN_COMMON = 2


@dataclass(frozen=True)
class Finished:
    """A finished scene: its model, and how it is rendered."""

    folder: Path
    gaussians: Gaussians
    views: list[View]
    up: NDArray[np.float64]
    options: RasterOptions


def read_finished(folder: Path) -> Finished:
    """Read a finished scene.

    Raises:
        UserError: It is missing, unfinished or damaged.
    """
    posed = posed_scene(folder, None, None)
    options = choose_protocol(posed.views, posed.split, posed.train).options(
        posed.train, usable_cores()
    )
    gaussians = read_npz(folder / "train" / "gaussians.npz")
    return Finished(folder, gaussians, posed.views, posed.up, options)


def measure(scene: Finished, against: Finished | None = None) -> list[NovelViewResult]:
    """The results of a scene, one for each kind of novel view.

    Raises:
        UserError: The model shows no surface, there is no free place beside the cameras, or
            ``against`` is not of the same photographs.
    """
    training = render_training_views(
        scene.views, lambda view: render_view(scene.gaussians, view, scene.options)
    )
    found = training and compare_novel_views(training, scene.up, scene.gaussians, scene.options)
    if not found:
        raise UserError(
            "expected a model with surfaces in front of its cameras, found none, or no free place "
            "beside the cameras",
            file=scene.folder,
        )
    agreements = None if against is None else _agreements(scene, found, against)
    results = []
    for kind, (number, (contradicted, unseen)) in found.by_kind().items():
        agreement: Sequence[float | None] = (None, None)
        if agreements is not None:
            which = [view.kind == kind for view in found.views]
            agreement = agreements[which].mean(axis=0).tolist()
        results.append(
            NovelViewResult(
                run=scene.folder.name,
                against="" if against is None else against.folder.name,
                kind=kind,
                views=number,
                contradicted_share=float(contradicted),
                unseen_share=float(unseen),
                psnr=agreement[0],
                ssim=agreement[1],
            )
        )
    return results


def _agreements(scene: Finished, found: NovelViews, other: Finished) -> NDArray[np.float64]:
    """(N, 2) PSNR and SSIM of the renders of two models from the novel views of the first."""
    similarity = _alignment(scene, other)
    rows = []
    for novel in found.views:
        view = reduced(novel.view, SIDE)
        one = render_rgb(scene.gaussians, view, scene.options)
        two = render_rgb(other.gaussians, _moved(view, similarity), other.options)
        rows.append((psnr(one, two), ssim(one, two)))
    return np.array(rows)


def _alignment(scene: Finished, other: Finished) -> Similarity:
    """From the world of one model to that of the other, by the cameras of equal names."""
    by_name = {view.name: view for view in other.views}
    pairs = [(view, by_name[view.name]) for view in scene.views if view.name in by_name]
    if len(pairs) < MIN_COMMON:
        raise UserError(
            f"expected a model of the same photographs as {scene.folder}, found "
            f"{len(pairs)} with equal names",
            file=other.folder,
            fix="train both from one folder of photographs, such as with two seeds",
        )
    rotations, centres = (
        [np.stack([value(pair[side]) for pair in pairs]) for side in (0, 1)]
        for value in (lambda view: view.world_to_camera[:3, :3], lambda view: view.centre)
    )
    return align_poses(rotations[0], centres[0], rotations[1], centres[1])


def _moved(view: View, similarity: Similarity) -> View:
    pose = np.eye(4)
    pose[:3, :3] = view.world_to_camera[:3, :3] @ similarity.rotation.T
    pose[:3, 3] = -pose[:3, :3] @ similarity(view.centre[None])[0]
    return replace(view, world_to_camera=pose)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.novel_views",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("results", type=Path, nargs="+", metavar="RESULTS", help="finished scenes")
    parser.add_argument(
        "--against", type=Path, metavar="RESULTS", help="another model of the same photographs"
    )
    add_record_options(parser)
    options = parser.parse_args(arguments)
    try:
        other = None if options.against is None else read_finished(options.against)
        found = [row for folder in options.results for row in measure(read_finished(folder), other)]
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return EXIT_USER_ERROR
    print(novel_views(found))
    if options.json is not None:
        write_record(options.json, measured("novel_views", options.note, arguments), found)
    return 0


if __name__ == "__main__":
    sys.exit(main())
