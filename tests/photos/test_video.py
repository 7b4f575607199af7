"""Frames are chosen by motion and sharpness; damaged videos are reported."""

from __future__ import annotations

import itertools
import os
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.config.schema import Video
from pipeline.io.videofile import read_video_facts
from pipeline.photos.verify import verify_videos
from pipeline.photos.video import (
    CELLS,
    MAX_GAP,
    MIN_GAP,
    FramesReport,
    Measured,
    choose_all,
    choose_frames,
    extract_frames,
    measure,
)
from pipeline.runtime.errors import ChangedFileError, UserError
from pipeline.scene.manifest import Manifest, VideoFile
from tests.tools import need_data
from tests.videos import panned, write_video


def video_of(path: Path) -> VideoFile:
    facts = read_video_facts(path)
    return VideoFile(name=path.stem, path=str(path), **facts.model_dump())


def extract(path: Path, out: Path, threads: int = 1, **options: int) -> FramesReport:
    manifest = Manifest(scene="s", photos=(), videos=(video_of(path),))
    return extract_frames(manifest, Video(**options), out, threads=threads)


def numbers(report: FramesReport) -> list[int]:
    return [int(Path(photo.name).stem) for photo in report.manifest.photos]


# --- choice -------------------------------------------------------------------------------

STEPS = st.sampled_from([0.0, 0.0, 0.001, 0.004, 0.01, 0.03, 0.25])
MEASURED = st.lists(st.tuples(STEPS, st.floats(0, 100)), min_size=1, max_size=80).map(
    lambda frames: Measured(
        np.cumsum([0.0, *(moved for moved, _ in frames[1:])]),
        np.array([sharpness for _, sharpness in frames]),
    )
)


@settings(max_examples=300, deadline=None, derandomize=True)
@given(MEASURED, st.floats(0.003, 0.2))
def test_chosen_frames_are_apart_and_leave_no_gap(video, step):
    chosen = choose_frames(video, step)
    motion = video.motion[chosen]
    tolerance = 1e-9
    assert np.all(np.diff(motion) >= (MIN_GAP - tolerance) * step)
    # A larger distance only where no frame is in between.
    for before, after in itertools.pairwise(motion):
        between = (video.motion > before + MIN_GAP * step + tolerance) & (video.motion < after)
        between &= video.motion <= before + (MAX_GAP - MIN_GAP) * step
        assert after - before <= (MAX_GAP + MIN_GAP) * step or not between.any()
    assert motion[0] - video.motion[0] <= (MIN_GAP + 1 / CELLS + tolerance) * step
    assert video.motion[-1] - motion[-1] <= (MIN_GAP + 1 / CELLS + tolerance) * step


@settings(max_examples=300, deadline=None, derandomize=True)
@given(MEASURED, st.floats(0.003, 0.2))
def test_no_sharper_frame_shows_the_same(video, step):
    for index in choose_frames(video, step):
        same = video.motion == video.motion[index]
        assert video.sharpness[index] == video.sharpness[same].max()


def test_blurred_frames_are_avoided_and_frames_are_as_dense_as_the_step():
    rng = np.random.default_rng(0)
    sharp = rng.random(600) < 0.2
    video = Measured(np.linspace(0, 3, 600), np.where(sharp, 100.0, rng.uniform(5, 50, 600)))
    chosen = choose_frames(video, 0.05)
    assert sharp[chosen].mean() > 0.8  # of 0.2 in all
    assert 50 <= len(chosen) <= 70


@settings(max_examples=200, deadline=None, derandomize=True)
@given(st.lists(MEASURED, min_size=1, max_size=4), st.integers(2, 60))
def test_all_videos_together_give_at_most_the_maximum(videos, max_frames):
    step, chosen = choose_all(videos, max_frames)
    assert sum(map(len, chosen)) <= max(max_frames, len(videos))
    assert all(chosen)
    assert chosen == [choose_frames(video, step) for video in videos]


def test_frames_far_apart_are_all_chosen():
    video = Measured(0.25 * np.arange(20.0), np.ones(20))
    assert choose_all([video], 150)[1] == [list(range(20))]


def test_a_slow_video_gives_more_frames_and_a_standing_one_does_not():
    slow = Measured(np.linspace(0, 0.5, 400), np.ones(400))
    assert 60 <= len(choose_all([slow], 150)[1][0]) <= 68
    standing = Measured(np.linspace(0, 0.004, 400), np.ones(400))
    assert len(choose_all([standing], 150)[1][0]) <= 2


# --- measurement --------------------------------------------------------------------------


def test_motion_is_measured_as_a_share_of_the_long_side(tmp_path):
    path = write_video(tmp_path / "pan.avi", panned(range(0, 240, 4)))
    motion = measure(video_of(path)).motion
    assert motion[0] == 0 and np.all(np.diff(motion) >= 0)
    assert motion[-1] == pytest.approx(236 / 160, rel=0.05)


def test_a_standing_camera_gives_few_frames(tmp_path):
    rng = np.random.default_rng(0)
    still = panned([100])[0]
    frames = [
        np.clip(still + rng.normal(0, 6, still.shape), 0, 255).astype(np.uint8) for _ in range(100)
    ]
    report = extract(write_video(tmp_path / "still.avi", frames), tmp_path / "out")
    assert report.total == {"still": 100}
    assert report.chosen["still"] <= 2


def test_repeated_frames_are_chosen_once(tmp_path):
    frames = panned(x for step in range(20) for x in [10 * step] * 3)
    report = extract(write_video(tmp_path / "slow.avi", frames), tmp_path / "out")
    assert [number // 3 for number in numbers(report)] == list(range(20))


def test_a_cut_to_another_view_is_motion(tmp_path):
    frames = panned([100] * 10) + panned([100] * 10, seed=1)
    chosen = numbers(extract(write_video(tmp_path / "cut.avi", frames), tmp_path / "out"))
    assert [number // 10 for number in chosen] == [0, 1]


def test_sharp_frames_are_preferred(tmp_path):
    frames = panned(range(0, 240, 2))
    frames[::2] = [np.asarray(cv2.GaussianBlur(f, (0, 0), 2.0), np.uint8) for f in frames[::2]]
    path = write_video(tmp_path / "blurred.avi", frames)
    chosen = numbers(extract(path, tmp_path / "out", max_frames=20))
    assert 15 <= len(chosen) <= 20
    assert all(number % 2 for number in chosen)


def test_frames_without_texture_are_no_motion(tmp_path):
    black = [np.zeros((120, 160, 3), np.uint8)] * 10
    path = write_video(tmp_path / "fade.avi", black + panned(range(0, 80, 4)))
    found = measure(video_of(path))
    assert found.motion[10] == 0 and found.motion[-1] == pytest.approx(76 / 160, rel=0.1)


# --- files --------------------------------------------------------------------------------


def test_frames_are_written_as_photographs(tmp_path):
    frames = panned(range(0, 200, 5))
    path = write_video(tmp_path / "pan.avi", frames)
    report = extract(path, tmp_path / "out", max_frames=12)
    manifest = Manifest.read(tmp_path / "out" / "images.json")
    assert manifest == report.manifest and manifest.videos == ()
    assert len(manifest.photos) == report.chosen["pan"] == len(set(numbers(report)))
    for photo in manifest.photos:
        number = int(Path(photo.name).stem)
        assert photo.name == f"pan/{number:06d}.png" and photo.camera_group == "pan 160x120"
        assert Path(photo.path) == tmp_path / "out" / "images" / photo.name
        found = cv2.imread(photo.path)
        assert found is not None and found.shape == (120, 160, 3)
        # Colours in the order of the source; MJPEG halves the resolution of colour.
        assert np.abs(found.astype(float) - frames[number]).mean() < 8
    (decision,) = report.decisions
    assert f"pan: {len(manifest.photos)} of 40 frames chosen" in decision


def test_the_number_of_threads_changes_nothing(tmp_path):
    path = write_video(tmp_path / "pan.mp4", panned(range(0, 200, 5)))
    one, three = (extract(path, tmp_path / str(n), threads=n) for n in (1, 3))
    assert [p.digest for p in one.manifest.photos] == [p.digest for p in three.manifest.photos]


def test_the_rotation_of_the_header_is_applied(tmp_path):
    path = write_video(tmp_path / "phone.mp4", panned(range(0, 80, 4)))
    data = bytearray(path.read_bytes())
    start = data.index(b"tkhd") + 44  # the matrix of the track header, version 0
    quarter = struct.pack(">9i", 0, 1 << 16, 0, -(1 << 16), 0, 0, 120 << 16, 0, 1 << 30)
    data[start : start + 36] = quarter
    path.write_bytes(data)
    facts = read_video_facts(path)
    assert (facts.width, facts.height) == (120, 160)
    photo = extract(path, tmp_path / "out").manifest.photos[0]
    assert (photo.width, photo.height) == (120, 160)
    found = cv2.imread(photo.path)
    assert found is not None
    turned = cv2.rotate(panned([0])[0], cv2.ROTATE_90_CLOCKWISE)
    assert np.abs(found.astype(float) - turned).mean() < 15


def test_a_video_that_ends_early_is_used_with_a_warning(tmp_path):
    path = write_video(tmp_path / "cut.avi", panned(range(0, 200, 5)))
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    report = extract(path, tmp_path / "out")
    (warning,) = report.warnings
    assert "cut.avi" in warning and "its header says 40" in warning
    assert 10 < report.total["cut"] < 30


def test_a_camera_that_stands_gives_too_few_frames(tmp_path):
    path = write_video(tmp_path / "still.avi", panned([100] * 30))
    manifest = Manifest(scene="s", photos=(), videos=(video_of(path),))
    with pytest.raises(UserError, match="only 1 frames were chosen of 1 videos"):
        extract_frames(manifest, Video(), tmp_path / "out", threads=1, min_photos=2)


def test_a_video_replaced_after_the_scan_is_an_error(tmp_path):
    path = write_video(tmp_path / "pan.avi", panned(range(0, 200, 5)))
    manifest = Manifest(scene="s", photos=(), videos=(video_of(path),))
    write_video(path, panned(range(0, 200, 5), seed=1))
    with pytest.raises(ChangedFileError, match=r"pan\.avi: has changed"):
        extract_frames(manifest, Video(), tmp_path / "out", threads=1)


@pytest.mark.parametrize("content", [b"", b"no video\n" * 50, b"#EXTM3U\n#EXTINF:1,\n/etc/hosts\n"])
def test_a_file_that_is_no_video_is_an_error(tmp_path, content, capfd):
    path = tmp_path / "notes.mp4"
    path.write_bytes(content)
    with pytest.raises(UserError, match=r"notes\.mp4: cannot be read as a video"):
        read_video_facts(path)
    assert capfd.readouterr().err == ""  # messages of OpenCV and FFmpeg


def test_a_pipe_is_not_opened(tmp_path):
    os.mkfifo(tmp_path / "pipe.mp4")
    with pytest.raises(UserError, match="not a regular file"):
        read_video_facts(tmp_path / "pipe.mp4")


def test_videos_without_a_decodable_frame_are_left_out(tmp_path):
    good = video_of(write_video(tmp_path / "good.avi", panned(range(0, 40, 4))))
    path = write_video(tmp_path / "bad.mp4", panned(range(0, 40, 4)))
    bad = video_of(path)
    path.write_bytes(path.read_bytes()[:2000])
    checked, (warning,) = verify_videos(Manifest(scene="s", photos=(), videos=(bad, good)))
    assert checked.videos == (good,) and "bad.mp4: left out" in warning
    with pytest.raises(UserError, match=r"none of the 1 videos can be decoded(.|\n)*bad\.mp4"):
        verify_videos(Manifest(scene="s", photos=(), videos=(bad,)))


def test_a_real_video(tmp_path):
    path = need_data("video_fern") / "fern.mp4"
    found = measure(video_of(path))
    ((step, (chosen,)), even) = choose_all([found], 10), np.linspace(0, 19, 10).astype(int)
    assert len(found.motion) == 20 and len(chosen) <= 10 and step > 0.003
    assert np.median(found.sharpness[chosen]) >= np.median(found.sharpness[even])
    assert choose_all([found], 150)[1] == [list(range(20))]
