"""Comparison of the frame of ground control points with the photographs' GPS positions, which are
less accurate, but independent."""

from __future__ import annotations

import numpy as np

from pipeline.scene.georeference import GeographicOrigin
from pipeline.sfm.georeference import Cameras, WorldFrame
from pipeline.sfm.gps_frame import Positions, from_gps, local_metres

# Distances that neither errors of GPS nor differences of datums explain: metres, and times the
# extent of the cameras.
MAX_OFFSET_M, MAX_OFFSET = 300.0, 1.0
# Smallest relative difference of scales that is a contradiction, and its multiple of the standard
# deviation.
MAX_SCALE, SIGMAS = 0.1, 4.0
MAX_HEADING_RAD = float(np.radians(15.0))


def contradictions(frame: WorldFrame, cameras: Cameras, positions: Positions) -> list[str]:
    """Sentences about scale, heading and place of a frame of ground control points that contradict
    GPS."""
    gps = from_gps(cameras, positions)
    found = []
    if isinstance(gps, WorldFrame) and gps.fit is not None:
        ratio = gps.similarity.scale / frame.similarity.scale
        scale, heading, _ = gps.fit.uncertainty
        if abs(np.log(ratio)) > max(MAX_SCALE, SIGMAS * scale):
            found.append(
                "the ground control points contradict the photographs' GPS: lengths by GPS are "
                f"{ratio:.3g} times as long; check the unit of the coordinates and the projection"
            )
        turn = frame.similarity.rotation @ gps.similarity.rotation.T
        angle = float(np.arctan2(turn[1, 0], turn[0, 0]))
        if abs(angle) > max(MAX_HEADING_RAD, SIGMAS * heading):
            found.append(
                "the ground control points contradict the photographs' GPS: the headings differ by "
                f"{abs(np.degrees(angle)):.0f} degrees; check the order and the signs of the "
                "coordinates"
            )
    offset = _offset(frame, cameras, positions)
    if offset is not None:
        found.append(
            f"the ground control points are {offset / 1000:.3g} km from the photographs' GPS "
            "positions: check the projection and the coordinates"
        )
    return found


def _offset(frame: WorldFrame, cameras: Cameras, positions: Positions) -> float | None:
    """Median horizontal distance of the cameras from their GPS positions, metres; None if it is
    small or unknown."""
    known = [i for i, name in enumerate(cameras.names) if name in positions]
    origin, projection = frame.origin, frame.projection
    if not known or origin is None or projection is None:
        return None
    ours = frame.similarity(cameras.centres[known])
    measured = np.array([positions[cameras.names[i]][:2] for i in known])
    if isinstance(origin, GeographicOrigin):
        place = np.array([origin.latitude, origin.longitude, 0.0])
        theirs = local_metres(measured, place)
        distances = np.linalg.norm(theirs - ours[:, :2], axis=1)
    else:
        degrees = projection.longitude_latitude((ours + origin.array) / projection.horizontal)
        if not np.isfinite(degrees).all():
            return None
        place = np.array([*np.median(measured, axis=0), 0.0])
        theirs = local_metres(measured, place)
        distances = np.linalg.norm(theirs - local_metres(degrees[:, ::-1], place), axis=1)
    extent = float(np.linalg.norm(ours[:, :2] - np.median(ours[:, :2], axis=0), axis=1).max())
    offset = float(np.median(distances))
    return offset if offset > max(MAX_OFFSET_M, MAX_OFFSET * extent) else None
