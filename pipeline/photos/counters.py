"""Counters of the stages that check, decode and undistort photographs."""

from __future__ import annotations

from pydantic import Field

from pipeline.runtime.counters import StageCounters


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
