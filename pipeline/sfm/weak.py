"""Refinement of a weak model: what the photographs determine, with priors for what they do not."""

from __future__ import annotations

from collections.abc import Mapping

import pycolmap

from pipeline.sfm.evidence import focal_certainty
from pipeline.sfm.judge import MIN_FOCAL_CERTAINTY
from pipeline.sfm.models import set_focal
from pipeline.sfm.refine import Refined, bundle_adjust

# Largest relative increase of the cost by the focal lengths of EXIF. Distortions are not adjusted
# to them: they would make up for wrong ones.
MAX_RISE = 0.01


def refine_weak(model: pycolmap.Reconstruction, priors: Mapping[int, float]) -> Refined:
    """Robust bundle adjustment of poses and points, and of focal lengths and distortions if the
    photographs determine the focal lengths. Otherwise focal lengths are held at those of EXIF, or
    if EXIF has none or contradicts the photographs, at those of the model.

    Args:
        model: The model, which is not changed.
        priors: The focal lengths from EXIF by camera id, pixels.
    """
    best = pycolmap.Reconstruction(model)
    if focal_certainty(model) >= MIN_FOCAL_CERTAINTY:
        bundle_adjust(best)
        return Refined(best, False, set(), ["weak model adjusted with principal points fixed"])
    cost = bundle_adjust(best, focal=False, distortion=False)
    source = "those of mapping"
    known = {i: priors[i] for i in best.cameras if i in priors}
    if known:
        held = pycolmap.Reconstruction(best)
        for camera_id, focal in known.items():
            set_focal(held.camera(camera_id), focal)
        held_cost = bundle_adjust(held, focal=False, distortion=False)
        if held_cost <= (1 + MAX_RISE) * cost:
            best, source = held, "those of EXIF"
    text = (
        "weak model adjusted with focal lengths fixed, because the photographs do not determine "
        f"them: they are {source}"
    )
    return Refined(best, False, set(), [text])
