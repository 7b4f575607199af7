"""COLMAP's mapper against GLOMAP's: cost of mapping, and differences between renders of the scenes
trained from either are.

For each seed both map the same verified matches, the same short training follows, and random
views between neighbouring cameras are rendered from all of the models. Two seeds of one mapper
differ, too: that is the scale to read the rest by. See docs/explanation/sfm.md.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.sfm.measure import Cost, measured, our_features, our_mapping, our_matches
from benchmarks.sfm.scenes import MAPPERS, Scene, load_scene, settled
from pipeline.config.schema import Config
from pipeline.geometry.rotations import quat_to_rotation, rotation_to_quat
from pipeline.geometry.similarity import umeyama
from pipeline.io.colmap import read_model
from pipeline.runtime.errors import UserError
from pipeline.scene.manifest import Manifest
from pipeline.scene.reconstruction import Reconstruction
from pipeline.sfm.isolate import run_isolated

Array = NDArray[np.float64]
Name = tuple[str, int]
"""Mapper and seed of a model."""
Likeness = tuple[float, float]
"""PSNR (dB) and SSIM between the renders of two models, means over the views."""


def compare_mappers(
    scene: Scene, raw: dict[str, object], seeds: int, views: int, threads: int
) -> tuple[dict[Name, Cost], dict[tuple[Name, Name], Likeness]]:
    """Cost of mapping of each model, and similarity of the renders of each pair of models.

    Raises:
        UserError: a mapper's model cannot be believed.
    """
    with tempfile.TemporaryDirectory(prefix="benchmark-mappers-") as temporary:
        base = Path(temporary)
        config = settled(scene, raw)
        run_isolated(our_features, scene.manifest, config, base, threads)
        costs: dict[Name, Cost] = {}
        folders: dict[Name, Path] = {}
        for seed in range(seeds):
            seeded = config.model_copy(update={"seed": seed})
            matched = base / f"seed{seed}"
            matched.mkdir()
            (matched / "features").symlink_to(base / "features")
            run_isolated(our_matches, scene.manifest, seeded, matched, threads)
            for mapper in MAPPERS:
                name, folder = (mapper, seed), base / f"{mapper}{seed}"
                folder.mkdir()
                (folder / "matches").symlink_to(matched / "matches")
                # A single attempt, so that the other mapper is not used.
                sfm = config.sfm.model_copy(update={"mapper": mapper, "max_attempts": 1})
                chosen = seeded.model_copy(update={"sfm": sfm})
                arguments = (scene.manifest, chosen, folder, threads)
                costs[name] = run_isolated(measured, our_mapping, arguments)
                run_isolated(_train, scene.manifest, config, folder, threads)
                folders[name] = folder
                print(f"{scene.name} {mapper} seed {seed}: trained", file=sys.stderr, flush=True)
        return costs, run_isolated(_compare, folders, config, views, threads)


def _train(manifest: Manifest, config: Config, folder: Path, threads: int) -> None:
    """As in the stages undistort, init and train, on all views; always with the same seed."""
    from pipeline.io.npz import write_npz
    from pipeline.photos.undistort import undistort
    from pipeline.scene.views import load_views, scene_extent
    from pipeline.splats.gaussians import Gaussians
    from pipeline.splats.init import gaussians_from_points
    from pipeline.training.data.inputs import Inputs
    from pipeline.training.data.known_depths import point_depths, scene_scale
    from pipeline.training.loop.train import train

    pinhole = folder / "pinhole"
    model = read_model(folder / "sparse" / "0")
    report = undistort(manifest, model, config.undistort, config.views, pinhole, threads=threads)
    model = read_model(pinhole / "sparse" / "0")
    views = load_views(report.manifest, model, config.views, config.split)
    first = gaussians_from_points(
        model.points, np.array([v.centre for v in views]), config.init, 0, config.experiments.init
    )
    extent = scene_extent(views)
    result = train(
        Inputs(
            views=views,
            initial=Gaussians.from_arrays(first),
            extent=extent,
            scale=scene_scale(extent, point_depths(views, model)),
        ),
        config.train,
        config.experiments.train,
        seed=config.seed,
        threads=threads,
        checkpoint_dir=folder / "checkpoints",
    )
    write_npz(folder / "gaussians.npz", result.gaussians)


def _compare(
    folders: dict[Name, Path], config: Config, count: int, threads: int
) -> dict[tuple[Name, Name], Likeness]:
    """Render the same views of all models, and compare each pair."""
    from pipeline.io.npz import read_npz
    from pipeline.metrics.image import psnr, ssim
    from pipeline.render import RasterOptions
    from pipeline.render.views import near_plane, render_view
    from pipeline.scene.views import load_views, scene_extent

    models = {name: read_model(folder / "pinhole/sparse/0") for name, folder in folders.items()}
    first = next(iter(folders))
    manifest = Manifest.read(folders[first] / "pinhole" / "images.json")
    seen = load_views(manifest, models[first], config.views, config.split)
    places = between(models[first], count)
    pictures = {}
    for name, folder in folders.items():
        gaussians = read_npz(folder / "gaussians.npz")
        scale, turn, shift = _similarity(models[first], models[name])
        near = near_plane(scale * scene_extent(seen))
        options = RasterOptions(near=near, threads=threads)
        found = []
        for rotation, centre in places:
            pose = np.eye(4)
            pose[:3, :3] = rotation @ turn.T
            pose[:3, 3] = -pose[:3, :3] @ (scale * turn @ centre + shift)
            view = replace(seen[0], world_to_camera=pose)
            rendered = render_view(gaussians, view, options)
            found.append(rendered.rgb)
        pictures[name] = found
    likeness = {}
    for a, b in combinations(folders, 2):
        each = [(psnr(x, y), ssim(x, y)) for x, y in zip(pictures[a], pictures[b], strict=True)]
        mean = np.mean(each, axis=0)
        likeness[a, b] = float(mean[0]), float(mean[1])
    return likeness


def between(model: Reconstruction, count: int) -> list[tuple[Array, Array]]:
    """Rotation (world to camera) and centre of ``count`` random views, each between a camera and
    one of its two nearest, at random; the same for the same model."""
    rng = np.random.default_rng(0)
    posed = [image for _, image in sorted(model.by_name().items())]
    centres = np.stack([image.centre for image in posed])
    quats = rotation_to_quat(np.stack([image.rotation for image in posed]))
    found = []
    for _ in range(count):
        i = int(rng.integers(len(posed)))
        near = np.argsort(np.linalg.norm(centres - centres[i], axis=1), kind="stable")[1:3]
        j, t = int(rng.choice(near)), rng.uniform()
        # Rotations of neighbours differ little: a normalised mean of quaternions is enough.
        sign = 1.0 if quats[i] @ quats[j] >= 0 else -1.0
        rotation = quat_to_rotation((1 - t) * quats[i] + t * sign * quats[j])
        found.append((rotation, (1 - t) * centres[i] + t * centres[j]))
    return found


def _similarity(source: Reconstruction, target: Reconstruction) -> tuple[float, Array, Array]:
    """The similarity between the worlds of two models, from the centres of common images."""
    a, b = source.by_name(), target.by_name()
    names = sorted(a.keys() & b.keys())
    return umeyama(*(np.stack([each[n].centre for n in names]) for each in (a, b)))


def tables(
    found: dict[str, tuple[dict[Name, Cost], dict[tuple[Name, Name], Likeness]]],
) -> str:
    """A Markdown table: medians over the seeds, and the range of the similarity."""
    lines = ["| scene | " + " | ".join(f"{m}, CPU s" for m in MAPPERS) + " |", "|---|---|---|"]
    for scene, (costs, _) in found.items():
        cells = [
            f"{statistics.median(c.cpu_s for (m, _), c in costs.items() if m == mapper):.1f}"
            for mapper in MAPPERS
        ]
        lines.append(f"| {scene} | {' | '.join(cells)} |")
    lines += [
        "",
        "| scene | renders of | pairs of models | PSNR, dB | SSIM |",
        "|---|---|---|---|---|",
    ]
    kinds = [(m, m) for m in MAPPERS] + [MAPPERS]
    for scene, (_, likeness) in found.items():
        for kind in kinds:
            own = [v for (a, b), v in likeness.items() if {a[0], b[0]} == set(kind)]
            if own:
                what = f"{kind[0]}, two seeds" if kind[0] == kind[1] else " against ".join(kind)
                cells = [
                    f"{statistics.median(v):{form}} ({min(v):{form}} to {max(v):{form}})"
                    for v, form in (([x[0] for x in own], ".2f"), ([x[1] for x in own], ".4f"))
                ]
                lines.append(f"| {scene} | {what} | {len(own)} | {' | '.join(cells)} |")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.sfm.mappers",
        description=__doc__,
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("scenes", type=Path, nargs="+", help="scene folders with known poses")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--views", type=int, default=100, help="number of views rendered")
    parser.add_argument("--steps", type=int, default=1000, help="steps of each training")
    parser.add_argument("--side", type=int, default=400, help="longer side of the images, px")
    parser.add_argument("--threads", type=int, default=1)
    args = parser.parse_args(arguments)
    raw: dict[str, object] = {
        "preset": "fast",
        "views": {"max_long_side_px": args.side},
        "split": {"test_every": 0},
        "train": {"steps": args.steps},
    }
    found = {}
    for folder in args.scenes:
        scene = load_scene(folder)
        found[scene.name] = compare_mappers(scene, raw, args.seeds, args.views, args.threads)
    print(tables(found))
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except UserError as error:
        sys.exit(f"error: {error}")
