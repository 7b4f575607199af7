"""Checks of given cameras against the photographs' headers, before any job starts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeline.io.folders import PhotoFolder
from pipeline.io.posefiles import GivenPoses
from pipeline.plan.given_poses import GivenFiles, read_fitted
from pipeline.plan.scene_folder import SceneFolder, digest_of_text
from pipeline.scene.manifest import Photo


def check_given(
    at: SceneFolder, poses: GivenPoses, chosen: PhotoFolder, photos: Sequence[Photo]
) -> float:
    """Check the sizes, focal lengths, principal points and distortion of the photographs' given
    cameras. The result is cached, since large models take seconds to read.

    Returns:
        The extent of the cameras in the given unit: the longest side of the box around them.

    Raises:
        UserError: See ``load_given``.
    """
    files = GivenFiles(at.path / poses.path, poses.kind, tuple(chosen.names), chosen.base)
    sizes = "\n".join(f"{photo.name}\0{photo.width}x{photo.height}" for photo in photos)
    state = [digest_of_text(sizes), files.base_folder]
    for file in at.pose_files(poses):
        state += [file.name, at.digest(file)]

    def extent() -> float:
        model = read_fitted(files, photos, points=False)
        centres = [image.centre for image in model.images.values()]
        return float(np.ptp(centres, axis=0).max()) if centres else 0.0

    return at.cache.get_for_state(f"cameras:{files.path}", state, float, extent)
