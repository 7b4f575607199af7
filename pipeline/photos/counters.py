"""Counters of the stages that check, decode and undistort photographs."""

from __future__ import annotations

from pydantic import Field

from pipeline.runtime.counters import StageCounters
from pipeline.runtime.text import counted


class InspectCounters(StageCounters):
    """Counters of the inspect stage."""

    photos: int = Field(ge=0, description="Number of photographs that are used.")
    left_out: int = Field(
        ge=0,
        description="Number of photographs that are left out: files that cannot be read, and one "
        "of each pair of a RAW file and another file.",
    )
    videos: int | None = Field(
        None, ge=0, description="Number of videos that are used; absent without videos."
    )
    given_poses: int | None = Field(
        None, ge=0, description="Number of given poses that are used; absent without given poses."
    )
    given_points: int | None = Field(
        None, ge=0, description="Number of given sparse points; absent without given poses."
    )
    cloud_points: int | None = Field(
        None, ge=0, description="Number of points in the point cloud; absent without one."
    )

    def headline(self) -> str:
        parts = [counted(self.photos, "photograph")] if self.photos or not self.videos else []
        parts += [counted(self.videos, "video")] if self.videos else []
        parts += [f"{self.left_out} left out"] if self.left_out else []
        parts += [counted(self.given_poses, "given pose")] if self.given_poses else []
        return ", ".join(parts)


class DecodeCounters(StageCounters):
    """Counters of the decode stage."""

    developed: int = Field(
        ge=0,
        description="Number of photographs after development, with those that are not RAW files.",
    )
    frames_chosen: dict[str, int] | None = Field(
        None,
        description="Name of each video to the number of its frames that are used; absent without "
        "videos.",
    )
    frames_decoded: dict[str, int] | None = Field(
        None,
        description="Name of each video to the number of frames that can be decoded; absent "
        "without videos.",
    )

    def headline(self) -> str:
        frames = sum((self.frames_chosen or {}).values())
        text = f"{counted(self.developed, 'photograph')} developed"
        return f"{counted(frames, 'video frame')} chosen" if frames else text


class UndistortCounters(StageCounters):
    """Counters of the undistort stage."""

    undistorted: int = Field(ge=0, description="Number of undistorted photographs.")
    split: int | None = Field(
        None,
        ge=0,
        description="Number of photographs that were split into several views (panoramas, wide "
        "fisheye lenses); absent without any.",
    )
    views: int | None = Field(
        None, ge=0, description="Number of views of all photographs; absent if none was split."
    )
    used_share: float | None = Field(
        None,
        ge=0,
        le=1,
        description="Share of the pixels of split photographs, inside the image circle of the "
        "lens, that are in some view; absent if none was split.",
    )

    def headline(self) -> str:
        text = f"{counted(self.undistorted, 'photograph')} undistorted"
        return (
            f"{counted(self.split, 'photograph')} split into {self.views} views"
            if self.split
            else text
        )
