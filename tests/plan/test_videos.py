"""Scans and plans of scenes with videos."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from pipeline.config.schema import Config
from pipeline.plan.plan import describe
from pipeline.plan.scan import Scan, scan
from pipeline.plan.settle import settle
from pipeline.plan.values import Plan
from pipeline.runtime.errors import UserError
from tests.pictures import photos
from tests.plan.test_scan import write_sparse
from tests.plans import make_plan
from tests.videos import panned, write_video


def look(folder: Path, cache: Path | None = None, **sections) -> Scan:
    return scan(folder, folder.name, Config.model_validate(sections), cache=cache)


def plan_of(folder: Path, **sections) -> Plan:
    return make_plan(look(folder, **sections), Config.model_validate(sections))


def clip(path: Path, count: int = 50, seed: int = 0) -> Path:
    return write_video(path, panned(range(count), seed))


def test_a_video_alone_is_a_scene(tmp_path):
    clip(tmp_path / "walk.mp4")
    found = look(tmp_path)
    (video,) = found.videos
    assert (found.photos, found.warnings, found.ordered) == ((), (), "frames of a video")
    assert (video.name, video.path) == ("walk", str(tmp_path / "walk.mp4"))
    assert (video.width, video.height, video.frames, video.fps) == (160, 120, 50, 25)

    plan = plan_of(tmp_path)
    assert plan.runs("decode") and plan.config.matches.pairs == "sequential"
    assert plan.stages["inspect"].reason == "1 video"
    assert plan.stages["decode"].reason == "1 video: at most 50 frames"
    assert plan.stages["decode"].decisions == ["walk: 50 frames of 160x120, 2 s"]
    assert plan.stages["features"].inputs == ["decode"]
    assert plan.facts.photographs == 0 and plan.facts.max_frames == 50
    assert "1 video" in describe(plan)


def test_the_plan_counts_at_most_max_frames(tmp_path):
    clip(tmp_path / "walk.mp4")
    few = plan_of(tmp_path, video={"max_frames": 20})
    assert few.facts.max_frames == 20 and few.config.matches.pairs == "exhaustive"
    assert few.config.train.depth_loss_weight > 0
    clip(tmp_path / "b.avi", 10)
    found = look(tmp_path).with_frames(30)
    names = [frame.name for frame in found.frames]
    assert names == [f"b/{i:06d}.png" for i in range(5)] + [f"walk/{i:06d}.png" for i in range(25)]
    assert found.ordered == "frames of 2 videos"
    assert settle(found, Config()).why["sfm.share_cameras"].endswith("each of 2 folders")


def test_photographs_and_videos_are_both_used(tmp_path):
    photos(tmp_path / "images", 3)
    clip(tmp_path / "a.mp4")
    clip(tmp_path / "images" / "b.mov", seed=1)
    clip(tmp_path / "videos" / "day" / "c.mkv", seed=2)
    clip(tmp_path / "masks" / "d.mp4", seed=3)
    found = look(tmp_path)
    assert len(found.photos) == 3
    assert [video.name for video in found.videos] == ["a", "images/b", "videos/day/c"]
    # Photographs without an order: neither do all together have one.
    assert found.ordered is None
    plan = plan_of(tmp_path)
    assert plan.stages["inspect"].reason == "3 photographs, 3 videos"
    assert plan.config.matches.pairs == "retrieval"
    assert plan.facts.camera_groups["images/b 160x120"] == 50
    # The inspect stage scans with the settled options.
    assert look(tmp_path, **plan.config.model_dump()).fingerprint == found.fingerprint


@pytest.mark.parametrize("place", [".", "images", "videos", "recordings/today"])
def test_videos_without_photographs_are_found_where_photographs_would_be(tmp_path, place):
    clip(tmp_path / place / "walk.mp4")
    found = look(tmp_path)
    assert len(found.videos) == 1
    settled = plan_of(tmp_path).config
    assert look(tmp_path, **settled.model_dump()).fingerprint == found.fingerprint


def test_frames_of_videos_with_equal_stems_have_their_own_names(tmp_path):
    clip(tmp_path / "walk.mp4")
    clip(tmp_path / "walk.avi", seed=1)
    photos(tmp_path / "images" / "tour", 2)
    clip(tmp_path / "tour.mp4", seed=2)
    names = [video.name for video in look(tmp_path).videos]
    assert names == ["tour.mp4", "walk.avi", "walk.mp4"]


def test_given_poses_leave_videos_out(tmp_path):
    photos(tmp_path / "images", 2)
    write_sparse(tmp_path / "sparse" / "0", ["p00.jpg", "p01.jpg"], (64, 48))
    clip(tmp_path / "walk.mp4")
    found = look(tmp_path)
    (warning,) = found.warnings
    assert found.videos == () and "poses: ignore uses them" in warning
    assert len(look(tmp_path, poses="ignore").videos) == 1


def test_the_fingerprint_is_of_the_video(tmp_path):
    clip(tmp_path / "walk.mp4")
    cache = tmp_path / ".facts.json"
    one = look(tmp_path, cache=cache)
    assert look(tmp_path, cache=cache) == one
    clip(tmp_path / "walk.mp4", seed=1)
    assert look(tmp_path, cache=cache).fingerprint != one.fingerprint


def test_videos_that_cannot_be_read_are_warnings_beside_good_ones(tmp_path):
    clip(tmp_path / "walk.mp4")
    cut = clip(tmp_path / "cut.mp4", seed=1)
    cut.write_bytes(cut.read_bytes()[: cut.stat().st_size // 2])  # The index at the end is missing.
    (tmp_path / "notes.mp4").write_text("no video")
    (tmp_path / "gone.mp4").symlink_to(tmp_path / "nowhere.mp4")
    os.mkfifo(tmp_path / "pipe.mp4")
    found = look(tmp_path)
    assert [video.name for video in found.videos] == ["walk"]
    assert len(found.warnings) == 4
    for name in ("cut.mp4", "notes.mp4", "gone.mp4", "pipe.mp4"):
        assert sum(line.startswith(f"{name}: left out") for line in found.warnings) == 1, name


def test_a_scene_of_broken_videos_is_one_error_that_names_them(tmp_path):
    (tmp_path / "notes.mp4").write_text("no video")
    with pytest.raises(UserError, match=r"none of the 1 photographs and videos can be read") as e:
        look(tmp_path)
    assert "notes.mp4: left out" in str(e.value)
    photos(tmp_path / "images", 2)
    assert len(look(tmp_path).photos) == 2
