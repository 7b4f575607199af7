"""Time of mapping against the number of photographs, on synthetic matches of a street.

Each camera stands a metre from the last and looks across the street, so that a point is seen by
some five cameras, however many there are. See docs/explanation/sfm.md.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Sequence
from math import log
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks import markdown, record_tables
from benchmarks.measured import add_record_options, measured, write_record
from benchmarks.results import GrowthResult
from benchmarks.sfm.measure import cost_of
from benchmarks.sfm.summary import Cost
from pipeline.config.settled import Sfm
from pipeline.geometry.cameras import Camera
from pipeline.io.colmap import read_model
from pipeline.metrics.pose import pose_error
from pipeline.runtime.errors import UserError
from pipeline.runtime.isolate import run_isolated
from pipeline.scene.manifest import Manifest, Photo
from pipeline.scene.reconstruction import PosedImage, Reconstruction

Array = NDArray[np.float64]

WIDTH, HEIGHT, FOCAL = 1000, 750, 1000.0
SPACING_M = 1.0
NEIGHBOURS = 5
NOISE_PX = 0.5
WRONG = 0.1
"""Share of wrong matches in a pair, before verification."""


def street(count: int) -> list[tuple[Array, Array]]:
    """The world-to-camera pose of each photograph."""
    rng = np.random.default_rng(0)
    found = []
    for index in range(count):
        yaw, pitch = np.radians(rng.uniform(-12, 12)), np.radians(rng.uniform(-4, 4))
        c, s = np.cos(yaw), np.sin(yaw)
        turn = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
        c, s = np.cos(pitch), np.sin(pitch)
        rotation = np.array([[1, 0, 0], [0, c, -s], [0, s, c]]) @ turn
        centre = np.array([SPACING_M * index, *rng.uniform(-0.5, 0.5, 2)])
        found.append((rotation, -rotation @ centre))
    return found


def make_database(path: Path, count: int, points: int) -> None:
    """Write verified matches between each camera and the next five, with about ``points`` points
    per photograph."""
    import pycolmap

    from pipeline.sfm.models import quiet_colmap

    quiet_colmap()
    rng = np.random.default_rng(1)
    # A photograph shows some 6 m of the street.
    total = int(points * (SPACING_M * count + 6) / 6)
    xyz = np.column_stack(
        [
            rng.uniform(-3, SPACING_M * count + 3, total),
            rng.uniform(-2.5, 2.5, total),
            rng.uniform(4, 8, total),
        ]
    )
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", 1.2 * WIDTH, WIDTH, HEIGHT)
    seen, places = [], []
    for rotation, translation in street(count):
        x, y, z = (xyz @ rotation.T + translation).T
        uv = np.column_stack([FOCAL * x / z + WIDTH / 2, FOCAL * y / z + HEIGHT / 2])
        inside = ((uv > 0) & (uv < [WIDTH, HEIGHT])).all(axis=1) & (z > 0)
        seen.append(np.flatnonzero(inside))
        places.append(uv[inside] + rng.normal(0, NOISE_PX, (len(seen[-1]), 2)))
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = 0
    with pycolmap.Database.open(path) as database, pycolmap.DatabaseTransaction(database):
        database.write_camera(camera, use_camera_id=True)
        rig = pycolmap.Rig(rig_id=1)
        rig.add_ref_sensor(camera.sensor_id)
        database.write_rig(rig, use_rig_id=True)
        for index in range(count):
            image = pycolmap.Image(name=name_of(index), camera_id=1, image_id=index + 1)
            database.write_image(image, use_image_id=True)
            frame = pycolmap.Frame(frame_id=index + 1, rig_id=1)
            frame.add_data_id(image.data_id)
            database.write_frame(frame, use_frame_id=True)
            table = np.column_stack([places[index], np.ones_like(places[index])])
            database.write_keypoints(index + 1, table.astype(np.float32))
        for first in range(count):
            for second in range(first + 1, min(first + 1 + NEIGHBOURS, count)):
                _, a, b = np.intersect1d(seen[first], seen[second], return_indices=True)
                matches = np.column_stack([a, b]).astype(np.uint32)
                wrong = rng.random(len(matches)) < WRONG
                matches[wrong, 1] = np.roll(matches[wrong, 1], 1)
                geometry = pycolmap.estimate_two_view_geometry(
                    camera, places[first], camera, places[second], matches, options
                )
                database.write_matches(first + 1, second + 1, matches)
                database.write_two_view_geometry(first + 1, second + 1, geometry)


def name_of(index: int) -> str:
    return f"{index:05d}.jpg"


def mapping(folder: Path, count: int, mapper: str) -> None:
    """Do what stages/sfm.py does."""
    from pipeline.sfm.mapping import reconstruct

    photos = [
        Photo(name=name_of(i), path="", width=WIDTH, height=HEIGHT, digest="") for i in range(count)
    ]
    manifest = Manifest(scene="street", photos=tuple(photos))
    config = Sfm.model_validate({"mapper": mapper})
    found = reconstruct(manifest, folder / "database.db", config, seed=0)
    found.write(folder / mapper)
    verdict = found.report.counters.verdict
    if verdict != "good":  # the other mapper has run as well
        raise UserError(f"{mapper} mapping of {count} photographs is {verdict}")


def growth_power(last: GrowthResult, views: int, cpu_s: float) -> float:
    """The exponent p of time proportional to views^p."""
    return log(cpu_s / last.cpu_s) / log(views / last.views)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.sfm.growth",
        description=__doc__,
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("--views", type=int, nargs="+", default=[50, 200, 1000])
    parser.add_argument("--points", type=int, default=500, help="approximate number per photograph")
    parser.add_argument(
        "--mappers",
        nargs="+",
        default=["incremental", "global"],
        choices=["incremental", "global"],
    )
    add_record_options(parser)
    args = parser.parse_args(arguments)
    truth_camera = Camera(
        "SIMPLE_RADIAL", WIDTH, HEIGHT, np.array([FOCAL, WIDTH / 2, HEIGHT / 2, 0.0])
    )
    print(markdown.table([record_tables.GROWTH_HEADING]), end="")
    results: list[GrowthResult] = []
    for count in args.views:
        images = {i: PosedImage(name_of(i), 1, *pose) for i, pose in enumerate(street(count))}
        truth = Reconstruction({1: truth_camera}, images)
        with tempfile.TemporaryDirectory(prefix="benchmark-growth-") as name:
            folder = Path(name)
            run_isolated(make_database, folder / "database.db", count, args.points)
            for mapper in args.mappers:
                cost: Cost = run_isolated(cost_of, mapping, (folder, count, mapper))
                error = pose_error(read_model(folder / mapper / "sparse" / "0"), truth)
                last = next((r for r in reversed(results) if r.mapper == mapper), None)
                results.append(
                    GrowthResult(
                        mapper=mapper,
                        views=count,
                        cpu_s=cost.cpu_s,
                        power=None if last is None else growth_power(last, count, cost.cpu_s),
                        peak_mb=cost.peak_mb,
                        registered=error.num_common,
                        rotation_deg=error.rotation_median_deg,
                        centre_m=error.centre_median,
                    )
                )
                print(markdown.line(record_tables.growth_row(results[-1])), flush=True)
    if args.json:
        write_record(args.json, measured("sfm.growth", args.note, arguments), results)
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except UserError as error:
        sys.exit(f"error: {error}")
