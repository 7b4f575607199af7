"""One line that says what was found in a scene folder."""

from __future__ import annotations

from pipeline.plan.values import SceneFacts


def found(facts: SceneFacts, frames_chosen: int | None = None) -> str:
    """A sentence such as "1 video, at most 38 of 412 frames; 12 photographs; poses: none".

    Args:
        frames_chosen: The number of video frames that are used; None before they are chosen.
    """
    parts = []
    if facts.videos:
        videos = "1 video" if facts.videos == 1 else f"{facts.videos} videos"
        total = facts.video_frames or "an unknown number of"
        if frames_chosen is None:
            parts.append(f"{videos}, at most {facts.max_frames} of {total} frames")
        else:
            parts.append(f"{videos}, {frames_chosen} of {total} frames chosen")
    if facts.photographs or not facts.videos:
        kinds = {"RAW or EXR": facts.linear, "panoramas": facts.panoramas}
        among = ", ".join(f"{count} {kind}" for kind, count in kinds.items() if count)
        parts.append(f"{facts.photographs} photographs" + (f" ({among})" if among else ""))
    counts = {"masks": facts.masks, "depth maps": facts.depths, "GPS positions": facts.gps}
    parts += [f"{name}: {count}" for name, count in counts.items() if count]
    if facts.ground_control:
        parts.append("ground control points")
    if facts.point_cloud is not None:
        parts.append(f"point cloud: {facts.point_cloud.text}")
    poses = facts.given_poses
    parts.append("poses: none" if poses is None else f"poses: {poses.label}")
    return "; ".join(parts)
