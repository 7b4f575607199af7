"""The kinds of pose files, and their names in messages."""

from __future__ import annotations

from typing import Literal

PoseKind = Literal[
    "colmap",
    "transforms",
    "llff",
    "metashape",
    "realitycapture_csv",
    "realitycapture_xmp",
    "polycam",
    "record3d",
    "scannet",
    "bundler",
    "opensfm",
    "openmvg",
    "pix4d",
    "pix4d_angles",
]

POSE_LABELS: dict[PoseKind, str] = {
    "colmap": "COLMAP model",
    "transforms": "transforms",
    "llff": "LLFF poses",
    "metashape": "Metashape cameras",
    "realitycapture_csv": "RealityCapture cameras",
    "realitycapture_xmp": "RealityCapture XMP files in",
    "polycam": "Polycam cameras",
    "record3d": "Record3D poses",
    "scannet": "ScanNet poses",
    "bundler": "Bundler cameras",
    "opensfm": "OpenSfM cameras",
    "openmvg": "OpenMVG cameras",
    "pix4d": "Pix4D cameras",
    "pix4d_angles": "Pix4D cameras",
}
