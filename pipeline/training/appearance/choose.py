"""The choice of a model for the appearance of photographs (``train.appearance``)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pipeline.photos.disagreement import ColourDisagreement, colour_disagreement
from pipeline.photos.exposure import observe, sample_views, solve_gains
from pipeline.photos.shading import (
    Light,
    Parts,
    choose_parts,
    fit_light,
    is_trusted,
    trusted,
    without_gains,
)
from pipeline.scene.collection import is_collection
from pipeline.scene.exposure import NO_GAINS, ExposureGains, ViewLight
from pipeline.scene.reconstruction import Reconstruction
from pipeline.scene.views import View

# Standard deviation in stops from which photographs are taken as differently exposed: with fixed
# exposure it is 0 to 0.1, in collections from the internet 0.5.
EXPOSURES_DIFFER = 0.2
# Disagreement on colours (``colour_disagreement``) from which photographs are taken to be in
# different light. In one light it is .03 with accurate points and up to .12 with inaccurate ones,
# vignetting or an automatic tone curve; in several lights, .15 or more.
COLOURS_DISAGREE = 0.135
# In a collection, photographs are taken to be in different light if fewer than this share of them
# can be compared: those in one light have matches, and so common points.
MEASURED_SHARE = 0.5


@dataclass
class AppearanceChoice:
    """How the colours of photographs differ.

    Attributes:
        gains: The light of all views; with embeddings of the training views alone. Empty if it is
            not modelled.
        shading: With embeddings, the light of all views without gains; empty if there is none.
        embeddings: Whether views have appearance embeddings.
        decisions: The sentences for the user.
        counters: The measured values by the names of their counters.
    """

    gains: ExposureGains = NO_GAINS
    shading: ExposureGains = NO_GAINS
    embeddings: bool = False
    decisions: list[str] = field(default_factory=list)
    counters: dict[str, float] = field(default_factory=dict)


def choose_appearance(
    views: Sequence[View],
    model: Reconstruction,
    points: NDArray[np.float64],
    wanted: str,
    *,
    cameras: Mapping[str, str],
    has_alpha: bool,
    in_blocks: bool,
) -> AppearanceChoice:
    """Choose the model of appearance that ``wanted`` names, or by measurement.

    Args:
        views: All views.
        points: (N, 3) of the scene, for a model without points.
        wanted: The option ``train.appearance``.
        cameras: The camera group of each photograph by name.
        has_alpha: Whether photographs have alpha. If so, exposure is not modelled.
        in_blocks: Whether the scene is trained in blocks: ``measured`` chooses no embeddings.
    """
    choice = AppearanceChoice(embeddings=wanted == "embedding")
    training = [view for view in views if not view.is_test]
    if choice.embeddings and not has_alpha:
        _choose_light_besides_embeddings(choice, views, model, cameras)
    if wanted in ("none", "embedding") or has_alpha:
        return choice
    collection = is_collection(list(cameras.values()))
    if wanted == "measured" and in_blocks and collection:
        choice.decisions.append(
            "photographs by many cameras may be in different light, but a scene in blocks has no "
            "appearance embeddings: those of different blocks would not agree "
            "(partition.blocks: 1 allows them)"
        )
    if wanted == "measured" and not in_blocks:
        found = colour_disagreement(training, model, points)
        choice.counters["colour_disagreement"] = round(found.value, 4)
        if reason := _reason_for_embeddings(found, collection):
            choice.embeddings = True
            choice.decisions.append(
                f"{reason}: each has an appearance embedding (train.appearance); the scene's own "
                "colours, which are exported, are those of the mean embedding and of the typical "
                "exposure"
            )
            _choose_light_besides_embeddings(choice, views, model, cameras)
            return choice
    _choose_light(choice, views, model, wanted, cameras)
    return choice


def _choose_light(
    choice: AppearanceChoice,
    views: Sequence[View],
    model: Reconstruction,
    wanted: str,
    cameras: Mapping[str, str],
) -> None:
    """Add the light of the photographs to ``choice``: gains for all if ``wanted`` is ``exposure``,
    else the parts of the model for which a sample of the photographs is evidence."""
    sample = observe(sample_views(views), model, cameras)
    parts, uses_gains = choose_parts(sample), wanted == "exposure"
    if wanted == "measured":
        spread = solve_gains(sample.point, sample.photo, sample.y, sample.num_photos).spread
        choice.counters["exposure_spread_stops"] = round(spread, 4)
        if spread >= EXPOSURES_DIFFER:
            uses_gains = is_trusted(sample, fit_light(sample, parts))
            if not uses_gains:
                choice.decisions.append(
                    f"exposures seem to differ by {spread:.2f} stops, but the parts of most images "
                    "do not agree on their gains: renders have none "
                    "(train.appearance: exposure uses them)"
                )
    if not uses_gains and parts == Parts():
        return
    seen = observe(views, model, cameras)
    fitted = fit_light(seen, parts)
    light = trusted(seen, fitted) if uses_gains else without_gains(fitted)
    if uses_gains:
        choice.decisions.append(
            f"exposures differ by {fitted.exposure_stops:.2f} stops: renders are multiplied by "
            f"gains that were measured in {fitted.measured} of {seen.num_photos} photographs, as "
            "far as parts of each image agree"
        )
    if parts.vignetting:
        _describe_vignetting(choice, light)
    if parts.slopes:
        choice.counters["slope_stops"] = round(light.slope_stops, 4)
        choice.decisions.append(
            f"brightness slopes across photographs, by {light.slope_stops:.2f} stops from the "
            "centre to the corner: renders are multiplied by the slope of each photograph"
        )
    choice.decisions.append(
        "the colours of the Gaussians are those of "
        + ("a photograph of typical exposure" if uses_gains else "the photographs")
        + (" at the centre of the image" if parts != Parts() else "")
    )
    choice.gains = _by_name(views, light.of_views(seen))


def _reason_for_embeddings(found: ColourDisagreement, collection: bool) -> str | None:
    """Why photographs need embeddings; None if they do not."""
    if collection and found.measured < MEASURED_SHARE:
        return (
            "photographs by many cameras see too few common points to compare their light "
            f"({found.measured:.0%} of them see enough)"
        )
    if found.value > COLOURS_DISAGREE:
        return f"photographs disagree on colours after exposure (by {found.value:.2f} in log2)"
    return None


def _choose_light_besides_embeddings(
    choice: AppearanceChoice,
    views: Sequence[View],
    model: Reconstruction,
    cameras: Mapping[str, str],
) -> None:
    """Add the gains of the training views to ``choice``, and the vignetting of the cameras if there
    is evidence of it. Gains of other views are fitted with their embeddings (``appearance.fit``):
    measured ones would show what the measured half of the photograph is."""
    training = [view for view in views if not view.is_test]
    parts = choose_parts(observe(sample_views(training), model, cameras))
    seen = observe(training, model, cameras)
    light = fit_light(seen, Parts(vignetting=parts.vignetting))
    choice.gains = _by_name(training, light.of_views(seen))
    if parts.vignetting:
        of_camera = {
            (view.camera_id, cameras.get(view.name, "")): of_view.vignetting
            for view, of_view in zip(training, light.of_views(seen), strict=True)
        }
        _describe_vignetting(choice, light)
        lights = [
            ViewLight(
                gain=(1.0, 1.0, 1.0),
                vignetting=of_camera.get((view.camera_id, cameras.get(view.name, "")), (0.0, 0.0)),
            )
            for view in views
        ]
        choice.shading = _by_name(views, lights)


def _describe_vignetting(choice: AppearanceChoice, light: Light) -> None:
    choice.counters["vignetting_stops"] = round(light.vignetting_stops, 4)
    choice.decisions.append(
        f"corners are darker than the centre of the image, by up to {light.vignetting_stops:.2f} "
        "stops: renders are multiplied by the vignetting of each camera"
    )


def _by_name(views: Sequence[View], light: Sequence[ViewLight]) -> ExposureGains:
    names = [view.name for view in views]
    return ExposureGains(dict(zip(names, light, strict=True)))
