"""``python -m benchmarks.coverage``: do the proposed viewpoints replace removed photographs?

For each case, removes views of the demo scene, trains on the others with true poses, proposes
viewpoints, and reports the distance from the proposals to the removed views, the rank correlation
of trust and error, and the gain in PSNR from one photograph at the first proposal. Distance and
gain are compared with those of random candidates. Prints JSON.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.stats import spearmanr

from benchmarks.measured import add_record_options, measured, write_record
from benchmarks.results import CoverageResult, Place
from pipeline.config.density import Gradient
from pipeline.config.experiments import TrainExperiments
from pipeline.config.settled import Init, TrainOptions
from pipeline.coverage.probe_views import Renderer, render_probe
from pipeline.coverage.trust import trust_map
from pipeline.coverage.viewpoints import MAX_PROPOSALS, Viewpoint, propose_viewpoints
from pipeline.demo.cameras import lens, look_at, orbit
from pipeline.demo.render import Rays, rays
from pipeline.demo.render import render as render_demo
from pipeline.demo.scene import OBJECTS, shadow_maps
from pipeline.demo.sensor import srgb, to_bytes
from pipeline.geometry.cameras import Camera
from pipeline.metrics.image import psnr
from pipeline.photos.load import load_rgb, resize_area
from pipeline.render import RasterOptions
from pipeline.render.views import Render, near_plane, render_view
from pipeline.scene.reconstruction import Points, PosedImage
from pipeline.scene.views import View, scene_extent
from pipeline.splats.gaussians import Gaussians
from pipeline.splats.init import gaussians_from_points
from pipeline.training.data.inputs import Inputs
from pipeline.training.loop.train import train
from pipeline.training.run import TrainingRun

Array = NDArray[np.float64]
UP = np.array([0.0, 0.0, 1.0])
POINTS_PER_VIEW = 300
BLOCK = 8
RING, HIGH = 32, 16
MAX_GAUSSIANS = 8000


@dataclass(frozen=True)
class Case:
    """The views to remove, as indices into ``cameras()``.

    Without ``above``, only the lower ring is photographed.
    """

    name: str
    removed: range
    above: bool = False


CASES = (
    Case("six neighbours of the ring", range(5, 11)),
    Case("six others", range(20, 26)),
    Case("five neighbours above", range(RING + 3, RING + 8), True),
    Case("all above", range(RING, RING + HIGH), True),
)


class Studio:
    """Renders photographs of the demo scene, with points of the surface that each shows."""

    def __init__(self, folder: Path, width: int, height: int):
        self.folder, self.camera = folder, lens("none", width, height)
        self.through: Rays = rays(self.camera)
        self.points: dict[str, tuple[Array, NDArray[np.uint8]]] = {}
        shadow_maps()

    def photograph(self, posed: PosedImage) -> View:
        camera: Camera = self.camera
        path = self.folder / posed.name
        seen = render_demo(posed, camera, self.through, OBJECTS)
        colour = to_bytes(srgb(seen.light))
        Image.fromarray(colour).save(path)
        fx, fy, cx, cy = camera.pinhole
        view = View(
            *(posed.name, str(path), None, camera.width, camera.height, fx, fy, cx, cy),
            posed.world_to_camera,
            False,
        )
        rng = np.random.default_rng(len(self.points))
        column = rng.integers(0, camera.width, POINTS_PER_VIEW)
        row = rng.integers(0, camera.height, POINTS_PER_VIEW)
        x, y = (column + 0.5 - cx) / fx, (row + 0.5 - cy) / fy
        local = np.stack([x, y, np.ones_like(x)], axis=1) * seen.depth[row, column, None]
        self.points[posed.name] = (
            (local - posed.translation) @ posed.rotation,
            colour[row, column],
        )
        return view

    def sparse(self, views: Sequence[View]) -> Points:
        """Points of the true surface that the views show, for the initialisation of training."""
        xyz, rgb = (np.concatenate([self.points[v.name][i] for v in views]) for i in (0, 1))
        return replace(Points.empty(), xyz=xyz, rgb=rgb)


def cameras() -> list[PosedImage]:
    """The demo's ring, and a smaller ring above it that looks down."""
    posed = orbit([f"ring_{i:02d}.png" for i in range(RING)], 0)
    for i in range(HIGH):
        angle = 2 * np.pi * i / HIGH
        centre = np.array([1.7 * np.cos(angle), 1.7 * np.sin(angle), 2.3])
        rotation = look_at(centre, np.array([0.0, 0.0, 0.4]))
        posed.append(PosedImage(f"high_{i:02d}.png", 1, rotation, -rotation @ centre))
    return posed


def train_scene(studio: Studio, views: Sequence[View], steps: int, extent: float) -> Gaussians:
    options = TrainOptions(
        steps=steps,
        density=Gradient(max_gaussians=MAX_GAUSSIANS),
        experiments=TrainExperiments(learning_rate_factor=4.0),
    )
    centres = np.stack([view.centre for view in views])
    first = gaussians_from_points(studio.sparse(views), centres, Init(), options.sh_degree)
    with TemporaryDirectory() as folder:
        return train(
            Inputs(views, Gaussians.from_arrays(first), extent),
            TrainingRun(options, Path(folder), threads=2),
        ).gaussians


def renderer(gaussians: Gaussians, near: float) -> Renderer:
    def render(view: View) -> Render:
        return render_view(gaussians, view, RasterOptions(near=near, threads=2))

    return render


def quality(render: Renderer, views: Sequence[View]) -> float:
    """Mean PSNR, dB."""
    return float(np.mean([psnr(render(view).rgb, load_rgb(view.image) / 255.0) for view in views]))


def run_case(
    case: Case, studio: Studio, views: list[View], steps: int, draws: int
) -> CoverageResult:
    """Train without the removed views, propose viewpoints, add the first one and train again."""
    used = range(RING + HIGH if case.above else RING)
    removed = [views[i] for i in case.removed]
    remaining = [views[i] for i in used if i not in case.removed]
    test, training = remaining[::8], [v for i, v in enumerate(remaining) if i % 8]
    extent = scene_extent(training)
    near = near_plane(extent)
    render = renderer(train_scene(studio, training, steps, extent), near)
    probes = [render_probe(view, render) for view in training]
    background_depth = float(np.percentile(np.concatenate([p.depth[~p.empty] for p in probes]), 95))
    best = propose_viewpoints(training, probes, render, UP, background_depth)
    trust, errors = {}, {}
    for name, group in (("test", test), ("removed", removed)):
        maps = [block_means(view, render, probes, background_depth) for view in group]
        trust[name], errors[name] = (np.concatenate([m[i] for m in maps]) for i in (0, 1))
    both = [np.concatenate(list(values.values())) for values in (trust, errors)]
    rng = np.random.default_rng(0)
    proposed = [proposal.viewpoint for proposal in best.proposals]
    random_draws = [draw_random(best.candidates, rng) for _ in range(1000)]
    before = {"test": quality(render, test), "removed": quality(render, removed)}

    def gain_from(viewpoint: Viewpoint, name: str) -> dict[str, float]:
        """Gain of one more photograph in mean PSNR, dB, over the test and the removed views."""
        added = photograph(studio, viewpoint, name)
        better = renderer(train_scene(studio, [*training, added], steps, extent), near)
        return {
            "test": quality(better, test) - before["test"],
            "removed": quality(better, removed) - before["removed"],
        }

    return CoverageResult(
        case=case.name,
        training_views=len(training),
        trust={name: float(values.mean()) for name, values in trust.items()},
        psnr=before,
        rank_correlation=float(spearmanr(*both).statistic),
        first=nearest(proposed[:1], removed),
        best_of_five=nearest(proposed, removed),
        random_first=median([nearest(found[:1], removed) for found in random_draws]),
        random_best_of_five=median([nearest(found, removed) for found in random_draws]),
        better_than_random=share_farther(proposed, random_draws, removed),
        added_first=gain_from(proposed[0], "first.png"),
        added_random=[
            gain_from(c[0], f"random_{i}.png") for i, c in enumerate(random_draws[:draws])
        ],
        surroundings=[best.trust_before, best.trust_after, len(best.candidates)],
    )


def block_means(
    view: View, render: Renderer, probes: list, background_depth: float
) -> tuple[Array, Array]:
    """Mean trust and mean squared error of blocks of ``BLOCK`` x ``BLOCK`` pixels of a view."""
    probe = render_probe(view, render)
    found, _ = trust_map(probe, probes, background_depth)
    error = ((render(view).rgb - load_rgb(view.image) / 255.0) ** 2).mean(axis=2)
    height, width = (side // BLOCK for side in found.shape)
    return tuple(  # type: ignore[return-value]
        resize_area(np.asarray(values, np.float32), width, height).ravel()
        for values in (found, error)
    )


def draw_random(viewpoints: Sequence[Viewpoint], rng: np.random.Generator) -> list[Viewpoint]:
    return [viewpoints[i] for i in rng.choice(len(viewpoints), MAX_PROPOSALS, replace=False)]


def photograph(studio: Studio, viewpoint: Viewpoint, name: str) -> View:
    pose = viewpoint.view.world_to_camera
    return studio.photograph(PosedImage(name, 1, pose[:3, :3], pose[:3, 3]))


def nearest(viewpoints: Sequence[Viewpoint], removed: Sequence[View]) -> Place:
    """Smallest distance (metres) between a viewpoint and a removed camera, and the angle between
    their viewing directions (degrees)."""
    pairs = [
        (
            float(np.linalg.norm(v.view.centre - r.centre)),
            angle(v.view.world_to_camera[2, :3], r.world_to_camera[2, :3]),
        )
        for v in viewpoints
        for r in removed
    ]
    return list(min(pairs))


def angle(a: Array, b: Array) -> float:
    return float(np.degrees(np.arccos(np.clip(a @ b, -1, 1))))


def median(pairs: list[Place]) -> Place:
    return [float(v) for v in np.median(pairs, axis=0)]


def share_farther(
    proposed: list[Viewpoint], random_draws: list[list[Viewpoint]], removed: list[View]
) -> float:
    """Share of the random draws whose first viewpoint is farther from every removed camera."""
    own = nearest(proposed[:1], removed)[0]
    return float(np.mean([nearest(found[:1], removed)[0] > own for found in random_draws]))


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.coverage", description=__doc__)
    parser.add_argument("--size", default="200x150", help="of the photographs, pixels, WxH")
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--draws", type=int, default=3, help="number of random draws to train with")
    parser.add_argument("--cases", type=int, nargs="*", default=[*range(len(CASES))])
    add_record_options(parser)
    options = parser.parse_args()
    width, height = map(int, options.size.split("x"))
    results: list[CoverageResult] = []
    with TemporaryDirectory() as folder:
        studio = Studio(Path(folder), width, height)
        views = [studio.photograph(posed) for posed in cameras()]
        for i in options.cases:
            results.append(run_case(CASES[i], studio, views, options.steps, options.draws))
            print(json.dumps(asdict(results[-1]), indent=1), flush=True)
    if options.json:
        write_record(options.json, measured("coverage", options.note), results)
    return 0


if __name__ == "__main__":
    sys.exit(main())
