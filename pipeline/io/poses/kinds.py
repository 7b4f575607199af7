"""The kinds of pose files, and their names in messages."""

from __future__ import annotations

from typing import Literal

PoseKind = Literal["colmap", "transforms", "llff", "metashape"]

POSE_LABELS: dict[PoseKind, str] = {
    "colmap": "COLMAP model",
    "transforms": "transforms",
    "llff": "LLFF poses",
    "metashape": "Metashape cameras",
}
