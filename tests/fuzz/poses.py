"""Pose files of other programs, by the writers of those formats' tests."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from pipeline.geometry.cameras import Camera
from pipeline.io.poses.formats import format_of
from pipeline.io.poses.kinds import PoseKind
from tests.fuzz.reader import Files, Reader
from tests.io.poses import test_metashape, test_photogrammetry, test_realitycapture
from tests.io.poses.known import HEIGHT, WIDTH, known_scene, opencv

PIX4D = "site_calibrated_camera_parameters.txt"
ANGLES = "a_calibrated_external_camera_parameters.txt"
CAM = "a_pix4d_calibrated_internal_camera_parameters.cam"


def each_first(files: dict[str, str]) -> Sequence[Files]:
    """The set of files once for each of them, which is the one that is mutated."""
    content = {name: text.encode() for name, text in files.items()}
    return [{name: content[name], **content} for name in content]


def brown() -> Camera:
    return test_photogrammetry.K3


def metashape() -> Sequence[Files]:
    lens = opencv(-0.1, 0.03, 1e-3, -2e-3)
    calibration = test_metashape.calibration(lens)
    return each_first({"cameras.xml": test_metashape.export(known_scene(lens), calibration)})


def opensfm() -> Sequence[Files]:
    lens = Camera("RADIAL", WIDTH, HEIGHT, np.array([500.0, WIDTH / 2, HEIGHT / 2, -0.1, 0.03]))
    camera = {"projection_type": "perspective", "width": WIDTH, "height": HEIGHT}
    camera |= {"focal": 500 / WIDTH, "k1": -0.1, "k2": 0.03}
    text = test_photogrammetry.opensfm_json(known_scene(lens), camera)
    return each_first({"reconstruction.json": text})


def openmvg() -> Sequence[Files]:
    return each_first({"sfm_data.json": test_photogrammetry.openmvg_json(known_scene(opencv()))})


def pix4d() -> Sequence[Files]:
    text = test_photogrammetry.pix4d_text(known_scene(brown()), np.array([5e5, 5e6, 300.0]))
    return each_first({PIX4D: text, "site_offset.xyz": "500000.0 5000000.0 300.0"})


def pix4d_angles() -> Sequence[Files]:
    known = known_scene(brown())
    poses, camera = test_photogrammetry.angles_text(known), test_photogrammetry.cam_text(brown())
    return each_first({ANGLES: poses, CAM: camera})


def bundler() -> Sequence[Files]:
    names = "".join(f"p{i}.jpg 0 700.5\n" for i in range(5))
    return each_first(
        {"bundle.out": test_photogrammetry.bundle(known_scene(opencv()), -0.1), "list.txt": names}
    )


def realitycapture_csv() -> Sequence[Files]:
    lens = test_realitycapture.camera(-0.1, 0.03, 1e-3, -2e-3)
    texts = [
        test_realitycapture.csv_text(known_scene(lens), k4=k4, first=first)
        for k4, first in ((0.0, ""), (1e-3, "#cameras 4"))
    ]
    return [{"cameras.csv": text.encode()} for text in texts]


def realitycapture_xmp() -> Sequence[Files]:
    known = known_scene(test_realitycapture.camera(), 2, names="p{}")
    found: list[Files] = []
    for model, coefficients in (("brown4t2", "-0.1 0.03 0 1e-4 0.001 0"), ("division", "-0.1")):
        found += each_first(
            {
                f"{image.name}.xmp": test_realitycapture.xmp_text(known, image, model, coefficients)
                for image in known.images.values()
            }
        )
    return found


SEEDS: dict[PoseKind, Callable[[], Sequence[Files]]] = {
    "metashape": metashape,
    "opensfm": opensfm,
    "openmvg": openmvg,
    "pix4d": pix4d,
    "pix4d_angles": pix4d_angles,
    "bundler": bundler,
    "realitycapture_csv": realitycapture_csv,
    "realitycapture_xmp": realitycapture_xmp,
}


def read_poses(kind: PoseKind) -> Callable[[Path], object]:
    """A reader that finds the file and reads the poses of all photographs that it lists."""

    def read(folder: Path) -> object:
        entry = format_of(kind)
        path = entry.find(folder)
        if path is None or entry.frames is None:  # no longer recognised
            return None
        sizes = {frame.name: (WIDTH, HEIGHT) for frame in entry.frames(folder / path)}
        found = entry.read(folder / path, sizes, ())
        assert all(np.isfinite(image.world_to_camera).all() for image in found.images.values())
        return found

    return read


POSES: dict[str, Reader] = {
    kind: Reader(seeds, read_poses(kind), weight=0.5) for kind, seeds in SEEDS.items()
}
