"""Refinement of a weak model: what the photographs determine, with priors for what they do not."""

from __future__ import annotations

from collections.abc import Mapping

import pycolmap

from pipeline.sfm.evidence import focal_certainty
from pipeline.sfm.judge import MIN_FOCAL_CERTAINTY
from pipeline.sfm.models import set_focal
from pipeline.sfm.refine import Refined, bundle_adjust


def refine_weak(model: pycolmap.Reconstruction, priors: Mapping[int, float]) -> Refined:
    """Robust bundle adjustment of poses, points and distortion; principal points are fixed. Focal
    lengths are refined if the photographs determine them. Otherwise they are those of EXIF, or if
    EXIF has none or contradicts the photographs, those of the model.

    Args:
        model: The model, which is not changed.
        priors: The focal lengths from EXIF by camera id, pixels.
    """
    best = pycolmap.Reconstruction(model)
    if focal_certainty(model) >= MIN_FOCAL_CERTAINTY:
        bundle_adjust(best)
        return Refined(best, False, set(), ["weak model adjusted; principal points fixed"])
    cost = bundle_adjust(best, focal=False)
    source = "the mapping's"
    known = {i: priors[i] for i in best.cameras if i in priors}
    if known:
        held = pycolmap.Reconstruction(best)
        for camera_id, focal in known.items():
            set_focal(held.camera(camera_id), focal)
        if bundle_adjust(held, focal=False) <= (1 + MIN_FOCAL_CERTAINTY) * cost:
            best, source = held, "EXIF's"
    text = (
        f"weak model adjusted; focal lengths fixed at {source}, because the photographs do not "
        "determine them; principal points fixed"
    )
    return Refined(best, False, set(), [text])
