"""Damaged pose files: every reader gives a message that names the file, or valid cameras."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pipeline.io.poses.formats import format_of
from tests.io import test_transforms
from tests.io.poses import test_metashape as metashape
from tests.io.poses import test_photogrammetry as programs
from tests.io.poses import test_realitycapture as reality
from tests.io.poses.known import error_or_valid, known_scene, mutated, opencv
from tests.io.poses.test_phone_scans import (
    record3d_json,
    write_polycam,
    write_record3d,
    write_scannet,
)

CURVED, K3 = programs.CURVED, programs.K3
SCENE, OF_K3 = known_scene(opencv(), 2), known_scene(K3, 2)
NUMBERED = known_scene(opencv(), 2, names="{}")
SQUARE = known_scene(reality.camera(), 2, names="p{}")
XMP = ("brown3", "-0.1 0.03 0.01 0 0 0")
BROWN = programs.opensfm_camera(K3, "brown", "k1", "k2", "p1", "p2", "k3")
ANGLES = programs.angles_text(OF_K3), programs.cam_text(K3)


def transforms() -> str:
    frames = [test_transforms.frame(path=f"images/{i}.png", k1=0.1 * i) for i in range(2)]
    content = {"fl_x": 400, "w": 640, "h": 480, "applied_scale": 0.5, "frames": frames}
    content |= {"train_filenames": ["images/0.png"], "test_filenames": ["images/1.png"]}
    return json.dumps(content)


# The single files of formats, and the functions that write several files.
TEXTS = {
    ("opensfm", "reconstruction.json"): programs.opensfm_json(OF_K3, BROWN),
    ("openmvg", "sfm_data.json"): programs.openmvg_json(SCENE, disto_k3=[-0.1, 0.03, 0.01]),
    ("pix4d", "a_calibrated_camera_parameters.txt"): programs.pix4d_text(OF_K3, np.zeros(3)),
    ("metashape", "cameras.xml"): metashape.export(SCENE, metashape.calibration(CURVED)),
    ("realitycapture_csv", "cameras.csv"): reality.csv_text(SQUARE),
    ("transforms", "transforms.json"): transforms(),
}
WRITERS = {
    "bundler": lambda folder: programs.write_bundle(folder, programs.bundle(SCENE), ["a", "b"]),
    "pix4d_angles": lambda folder: programs.write_angles(folder, *ANGLES),
    "realitycapture_xmp": lambda folder: reality.write_xmp(folder, SQUARE, *XMP),
    "polycam": lambda folder: write_polycam(folder, NUMBERED),
    "record3d": lambda folder: write_record3d(folder, record3d_json(SCENE)),
    "scannet": lambda folder: write_scannet(folder, NUMBERED),
}
CASES = [
    *TEXTS,
    ("bundler", "bundle.out"),
    ("pix4d_angles", "a_calibrated_external_camera_parameters.txt"),
    ("pix4d_angles", "a_pix4d_calibrated_internal_camera_parameters.cam"),
    ("realitycapture_xmp", "images/p0.xmp"),
    ("polycam", "keyframes/corrected_cameras/0.json"),
    ("record3d", "metadata"),
    ("scannet", "pose/0.txt"),
    ("scannet", "intrinsic/intrinsic_color.txt"),
]


@settings(
    max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@pytest.mark.parametrize(("kind", "name"), CASES)
@given(data=st.data())
def test_a_damaged_file_gives_a_message_or_valid_cameras(tmp_path: Path, kind, name, data):
    file = tmp_path / name
    if (kind, name) in TEXTS:
        file.write_text(TEXTS[kind, name])
    else:
        WRITERS[kind](tmp_path)
    entry = format_of(kind)
    path = tmp_path / entry.find(tmp_path)
    file.write_bytes(data.draw(mutated(file.read_text())))
    error_or_valid(entry.frames, path)
