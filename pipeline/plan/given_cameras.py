"""Checks of given cameras against the photographs' headers, before any job starts."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from functools import partial

import numpy as np

from pipeline.io.fact_cache import FactCache
from pipeline.io.posefiles import pose_files
from pipeline.io.recorded import digest_of
from pipeline.plan.given_poses import GivenFiles, read_fitted
from pipeline.scene.manifest import Photo


def check_given(files: GivenFiles, photos: Sequence[Photo], cache: FactCache) -> float:
    """Check the given cameras of the photographs: sizes, focal lengths, principal points and
    distortion. The result is cached, since large models take seconds to read.

    Returns:
        The extent of the cameras in the given unit: the longest side of the box around them.

    Raises:
        UserError: as ``load_given``.
    """
    sizes = "\n".join(f"{photo.name}\0{photo.width}x{photo.height}" for photo in photos)
    state = [hashlib.blake2b(sizes.encode(), digest_size=16).hexdigest(), files.base_folder]
    for file in pose_files(files.path, files.kind):
        state += [file.name, cache.get(file, "digest", str, partial(digest_of, file))]

    def extent() -> float:
        model = read_fitted(files, photos, points=False)
        centres = [image.centre for image in model.images.values()]
        return float(np.ptp(centres, axis=0).max()) if centres else 0.0

    return cache.get_for_state(f"cameras:{files.path}", state, float, extent)
