"""Collections of photographs by many people, as from the internet: photographs of the same size
need not share a camera, and are in different light."""

from __future__ import annotations

from collections.abc import Collection, Sequence

# At least so many camera bodies, or so many camera groups per photograph.
MIXED_BODIES = 3
MIXED_GROUP_SHARE = 0.5


def camera_bodies(groups: Collection[str]) -> set[str]:
    """Bodies of the cameras in camera groups (``Photo.camera_group``); those without EXIF have
    none."""
    return {group.split(" | ")[0] for group in groups if " | " in group}


def is_collection(groups: Sequence[str]) -> bool:
    """Whether photographs with these camera groups are by many cameras."""
    several = len(groups) > 2 and len(set(groups)) > MIXED_GROUP_SHARE * len(groups)
    return several or len(camera_bodies(groups)) >= MIXED_BODIES
