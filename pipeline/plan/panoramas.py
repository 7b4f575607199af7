"""Panoramas among a scene's photographs: hints and checks of the plan."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from pipeline.config.schema import Config
from pipeline.io.photofile import FileFacts
from pipeline.runtime.errors import UserError
from pipeline.scene.manifest import Photo


def partial_panoramas(facts: Mapping[str, FileFacts]) -> list[str]:
    """A warning about panoramas that do not show the whole sphere."""
    found = [name for name in sorted(facts) if facts[name].panorama == "partial"]
    if not found:
        return []
    return [
        f"{len(found)} photographs are panoramas that do not show the whole sphere (first: "
        f"{found[0]}), and are used as ordinary photographs; leave them out, or pad them to 360 by "
        "180 degrees"
    ]


def panorama_hints(maybe: Sequence[str], config: Config) -> list[str]:
    """A warning about photographs that only their aspect ratio suggests to be panoramas."""
    if not maybe or config.sfm.camera_model != "auto":
        return []
    return [
        f"{len(maybe)} photographs have the aspect ratio 2:1 of a 360 degree panorama (first: "
        f"{maybe[0]}); if they are panoramas, set sfm.camera_model: EQUIRECTANGULAR"
    ]


def check_panorama_sizes(photos: Sequence[Photo]) -> None:
    """Raises: UserError: ``sfm.camera_model`` is EQUIRECTANGULAR, and a photograph is not 2:1."""
    for photo in photos:
        if photo.width != 2 * photo.height:
            raise UserError(
                f"sfm.camera_model is EQUIRECTANGULAR, but the photograph is {photo.width}x"
                f"{photo.height} pixels; a panorama of 360 by 180 degrees is twice as wide as high",
                file=photo.path,
                fix="leave the photograph out, or set sfm.camera_model: auto",
            )
