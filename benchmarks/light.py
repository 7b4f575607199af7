"""Photographs that differ in light, exposure and lens, with passers-by and with holes.

    python -m benchmarks.light plain lights collection --size 240x180 --json RECORD.json

Every world is the demo scene in other conditions (``WORLDS``), trained with its exact poses and
points. Its test views are in the reference conditions of the plain world. The record is written
after every run, and finished runs of the same checkout are kept: the same command continues an
interrupted one.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from pydantic import ValidationError

from benchmarks.measured import Measured, Record, add_record_options, measured, write_record
from benchmarks.record_tables import light
from benchmarks.results import LightResult
from pipeline.config.density import Gradient
from pipeline.config.experiments import InitExperiments
from pipeline.config.schema import Evaluate, Split, Views
from pipeline.config.settled import Background, Init, TrainOptions
from pipeline.demo.capture import Conditions
from pipeline.demo.options import picture_size
from pipeline.demo.write import WITHHELD, DemoSpec, write_demo
from pipeline.io.colmap import read_model
from pipeline.io.photofile import read_facts
from pipeline.metrics.evaluate import evaluate_views
from pipeline.metrics.image import psnr
from pipeline.metrics.protocol import choose_protocol
from pipeline.photos.load import load_rgb
from pipeline.render.views import render_view, to_bytes
from pipeline.runtime.errors import EXIT_USER_ERROR, UserError
from pipeline.runtime.machine import usable_cores
from pipeline.scene.appearance import fitted_columns
from pipeline.scene.manifest import Manifest, Photo
from pipeline.scene.views import View, load_views
from pipeline.splats.first import InitPoints, first_gaussians
from pipeline.splats.gaussians import Gaussians
from pipeline.training.run import TrainingRun
from pipeline.training.scene import SceneData, train_scene

CLEAN = Conditions(tests="clean")
WORLDS: dict[str, Conditions] = {
    "plain": CLEAN,
    "exposures": replace(CLEAN, exposures=3),
    "lenses": replace(CLEAN, lenses=2),
    "ramps": replace(CLEAN, ramp=0.7),
    "lights": replace(CLEAN, lights=5),
    "collection": replace(CLEAN, lights=5, exposures=3, lenses=2),
    "walkers": replace(CLEAN, walkers=0.25),
    "holes": replace(CLEAN, withhold=0.2),
}


@dataclass(frozen=True)
class Setup:
    """How a world is made and trained.

    Attributes:
        size: The width and height of the photographs in pixels.
        views: The number of photographs.
        gaussians: The largest number of Gaussians.
        appearance: The option ``train.appearance``.
    """

    size: tuple[int, int]
    views: int
    steps: int
    gaussians: int
    appearance: str
    work: Path

    def options(self) -> TrainOptions:
        return TrainOptions.model_validate(
            {
                "steps": self.steps,
                "appearance": self.appearance,
                "transients": "find",
                "density": Gradient(max_gaussians=self.gaussians),
            }
        )

    def made(self, result: LightResult, world: str, seed: int) -> bool:
        """Whether a result is of a world with this setup."""
        pixels = f"{self.size[0]}x{self.size[1]}"
        mine = (world, seed, pixels, self.views, self.steps, self.appearance)
        return mine == (
            *(result.world, result.seed, result.pixels, result.views, result.steps, result.option),
        )


def write_world(setup: Setup, world: str, seed: int) -> Path:
    """The folder of a world, which is written unless it is there."""
    width, height = setup.size
    spec = DemoSpec(
        views=setup.views,
        width=width,
        height=height,
        distortion="none",
        poses="colmap",
        seed=seed,
        conditions=WORLDS[world],
    )
    folder = setup.work / f"{world}_{setup.views}_{width}x{height}_{seed}"
    if not folder.exists():
        write_demo(folder, spec, usable_cores())
    return folder


def read_scene(folder: Path) -> SceneData:
    """The photographs of a world with their given poses and points."""
    model = read_model(folder / "sparse" / "0")
    manifest = Manifest(scene=folder.name, photos=_photos(folder / "images"))
    return SceneData(load_views(manifest, model, Views(), Split()), manifest, model)


def _photos(images: Path) -> tuple[Photo, ...]:
    photos = []
    for path in sorted(images.iterdir()):
        facts = read_facts(path)
        known = facts.model_dump(include={"width", "height", "digest", "focal_px"})
        group = facts.camera_group
        photos.append(Photo(name=path.name, path=str(path), camera_group=group, **known))
    return tuple(photos)


def measure(setup: Setup, world: str, seed: int) -> LightResult:
    """Train and evaluate a world."""
    folder = write_world(setup, world, seed)
    scene, options, threads = read_scene(folder), setup.options(), usable_cores()
    start = time.perf_counter()
    with TemporaryDirectory() as scratch:
        run = TrainingRun(options, Path(scratch), seed=seed, threads=threads)
        trained = train_scene(scene, first_of(scene, seed), run)
    seconds = time.perf_counter() - start
    gaussians, appearance = trained.result.gaussians, trained.result.appearance
    protocol = choose_protocol(scene.views, Split(), options)
    renders = folder / f"renders_{setup.appearance}_{setup.steps}"
    evaluation = evaluate_views(
        gaussians,
        protocol,
        Evaluate(lpips_net="none"),
        options,
        renders,
        gains=trained.gains,
        appearance=appearance,
        threads=threads,
    )
    images = {view.name: Path(view.image) for view in protocol.views}
    right = [_right(renders / m.render, images[m.name]) for m in evaluation.per_view]
    raster = protocol.options(options, threads)
    hidden = [
        psnr(to_bytes(render_view(gaussians, view, raster).rgb), load_rgb(view.image))
        for view in withheld_views(folder)
    ]
    return LightResult(
        world=world,
        seed=seed,
        views=setup.views,
        pixels=f"{setup.size[0]}x{setup.size[1]}",
        steps=setup.steps,
        option=setup.appearance,
        chosen="embedding" if appearance else "exposure" if trained.gains else "none",
        gaussians=len(gaussians),
        psnr=evaluation.psnr,
        psnr_right=float(np.mean(right)),
        psnr_own=evaluation.psnr_without_fit or evaluation.psnr_without_gains or evaluation.psnr,
        psnr_withheld=float(np.mean(hidden)) if hidden else None,
        seconds=seconds,
    )


def first_of(scene: SceneData, seed: int, background: Background = "black") -> Gaussians:
    """The Gaussians that training starts with."""
    training = [view for view in scene.views if not view.is_test]
    points = InitPoints(scene.model.points)
    first = first_gaussians(points, training, Init(), InitExperiments(), seed, background)
    return Gaussians.from_arrays(first.gaussians.arrays())


def _right(render: Path, photograph: Path) -> float:
    """The PSNR in the right half, where no appearance is fitted, in dB."""
    one, two = load_rgb(render), load_rgb(photograph)
    first = fitted_columns(two.shape[1])
    return psnr(one[:, first:], two[:, first:])


def withheld_views(folder: Path) -> list[View]:
    """The views that are not in the scene; empty if there are none."""
    images = folder / WITHHELD / "images"
    if not images.is_dir():
        return []
    manifest = Manifest(scene=folder.name, photos=_photos(images))
    return load_views(manifest, read_model(images.parent / "sparse_gt"), Views(), Split())


def finished(file: Path | None, facts: Measured) -> list[LightResult]:
    """The results of an earlier call.

    Raises:
        UserError: The record cannot be read, or is of another checkout or machine.
    """
    if file is None or not file.exists():
        return []
    try:
        found = Record[LightResult].model_validate_json(file.read_bytes())
    except (OSError, ValidationError) as error:
        raise UserError(
            f"expected a record of this benchmark: {error}", file=file, fix="name another file"
        ) from None
    if (found.commit, found.processor) != (facts.commit, facts.processor):
        raise UserError(
            "its results are of another commit or processor", file=file, fix="name another file"
        )
    return found.results


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.light",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("worlds", nargs="*", default=[*WORLDS], metavar="WORLD", help=f"of {', '.join(WORLDS)}")
    add("--size", type=picture_size, default=(240, 180), metavar="WIDTHxHEIGHT")
    add("--views", type=int, default=48, help="photographs of a world")
    add("--steps", type=int, default=1500)
    add("--gaussians", type=int, default=12_000, help="upper limit of their number")
    add("--appearance", default="measured", help="the option train.appearance")
    add("--seeds", type=int, nargs="+", default=[0], metavar="N")
    add("--work", type=Path, default=Path("build/light"), help="folder for the worlds")
    add_record_options(parser)
    asked = parser.parse_args(arguments)
    setup = Setup(
        asked.size, asked.views, asked.steps, asked.gaussians, asked.appearance, asked.work
    )
    try:
        if unknown := [world for world in asked.worlds if world not in WORLDS]:
            raise UserError(f"unknown world {unknown[0]}", fix=f"name some of {', '.join(WORLDS)}")
        facts = measured("light", asked.note, arguments)
        found = finished(asked.json, facts)
        for seed in asked.seeds:
            for world in asked.worlds:
                if not any(setup.made(result, world, seed) for result in found):
                    found.append(measure(setup, world, seed))
                    if asked.json is not None:
                        write_record(asked.json, facts, found)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return EXIT_USER_ERROR
    print(light(found))
    return 0


if __name__ == "__main__":
    sys.exit(main())
