"""The largest video stream is used, whole, whatever else a file has."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.config.schema import Config
from pipeline.io.video_tracks import PatchedFile, choose_track
from pipeline.io.videofile import opened_video, read_video_facts
from pipeline.photos.video import extract_frames
from pipeline.plan.scan import scan
from pipeline.scene.manifest import Manifest, VideoFile
from tests.movies import Stream, jpeg, sound, video, write_avi, write_mkv, write_mov
from tests.plans import make_plan

LARGE, SMALL = (160, 120), (80, 60)
WRITERS: dict[str, Callable[[Path, Sequence[Stream]], Path]] = {
    "mov": write_mov,
    "mkv": write_mkv,
    "avi": write_avi,
}


@dataclass(frozen=True)
class Decoded:
    count: int
    grey: int
    size: tuple[int, int]


def decoded(path: Path) -> Decoded:
    """All frames of a file."""
    count, grey, size = 0, 0, (0, 0)
    with opened_video(path) as capture:
        while True:
            good, frame = capture.read()
            if not good:
                return Decoded(count, grey, size)
            count, grey = count + 1, round(float(frame.mean()))
            size = frame.shape[1], frame.shape[0]


@settings(max_examples=60, deadline=None, derandomize=True)
@given(
    writer=st.sampled_from(sorted(WRITERS)),
    frames=st.integers(10, 30),
    pause_s=st.sampled_from([0, 0, 3, 130]),
    others=st.lists(st.sampled_from(["small", "few", "sound"]), max_size=3),
    place=st.integers(0, 3),
    cover=st.sampled_from(["none", "first", "last"]),
)
def test_the_largest_stream_is_decoded_whole(writer, frames, pause_s, others, place, cover):
    """The file also has previews, larger single pictures, sound, covers and pauses."""
    length = pause_s + 2
    others_of = {
        "small": lambda: video(SMALL, frames, 50),
        "few": lambda: video((640, 480), 1, 90),
        "sound": lambda: sound(length),
    }
    streams = [others_of[kind]() for kind in others]
    streams.insert(min(place, len(streams)), video(LARGE, frames, 200, pause_s))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"a.{writer}"
        if writer == "mov" and cover != "none":
            write_mov(path, streams, jpeg((300, 300), 120), cover == "first")
        else:
            WRITERS[writer](path, streams)
        facts = read_video_facts(path)
        found = decoded(path)
    assert found == Decoded(frames, 200, LARGE)
    assert (facts.width, facts.height, facts.frames) == (*LARGE, frames)
    assert facts.counted and not facts.truncated and facts.alike == 1
    assert len(facts.others) == sum(kind != "sound" for kind in others)


def test_a_pause_with_sound_loses_no_frame(tmp_path):
    """90 frames with 130 s of sound between two of them: more packets than OpenCV reads."""
    path = write_mov(tmp_path / "gap.mov", [video(LARGE, 90, 80, pause_s=130), sound(134)])
    videos = (VideoFile(name="gap", path=str(path), **read_video_facts(path).model_dump()),)
    manifest = Manifest(scene="s", photos=(), videos=videos)
    report = extract_frames(manifest, Config().video, tmp_path / "out", threads=1)
    assert report.total == {"gap": 90} and report.warnings == ()


def test_frames_of_matroska_are_counted_and_not_estimated_from_its_length(tmp_path):
    path = write_mkv(tmp_path / "gap.mkv", [video(LARGE, 40, 80, pause_s=130)], known_size=False)
    assert read_video_facts(path).frames == decoded(path).count == 40


@pytest.mark.parametrize(
    "edits, shown",
    [([(1000, 600)], 25), ([(400, 0), (400, 1200)], 20), ([(5000, -1), (3600, 0)], 90)],
)
def test_frames_that_an_edit_cuts_off_are_not_missing(tmp_path, edits, shown):
    path = write_mov(tmp_path / "cut.mov", [video(LARGE, 90, 80, edits=edits)])
    assert read_video_facts(path).frames == decoded(path).count == shown


@pytest.mark.parametrize("writer", sorted(WRITERS))
def test_the_plan_names_streams_that_are_not_used(tmp_path, writer):
    WRITERS[writer](tmp_path / f"walk.{writer}", [video(SMALL, 40, 1), video(LARGE, 40, 2)])
    found = scan(tmp_path, "s", Config(), cache=None)
    (decision,) = make_plan(found, Config()).stages["decode"].decisions
    assert "40 frames of 160x120" in decision
    assert decision.endswith("the largest of 2 video streams (not used: 80x60)")
    assert found.warnings == ()


def test_two_lenses_are_named_in_the_plan(tmp_path):
    write_mov(tmp_path / "walk.mov", [video(LARGE, 40, 1), video(LARGE, 40, 2)])
    (warning,) = scan(tmp_path, "s", Config(), cache=None).warnings
    assert warning.startswith("walk.mov: 2 video streams of the same size, of which one is used")


@pytest.mark.parametrize("writer", ["mkv", "avi"])
def test_a_file_that_ends_early_is_named_in_the_plan(tmp_path, writer):
    path = WRITERS[writer](tmp_path / f"walk.{writer}", [video(LARGE, 40, 1)])
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    (warning,) = scan(tmp_path, "s", Config(), cache=None).warnings
    assert warning.startswith(f"walk.{writer}: its end is missing")
    assert decoded(path).count >= 15


def test_a_damaged_header_is_left_to_ffmpeg(tmp_path):
    """Any byte of a header may have any value: the only error is that of the whole file."""
    rng = np.random.default_rng(0)
    for name, writer in WRITERS.items():
        whole = writer(
            tmp_path / f"a.{name}", [video(SMALL, 3, 1), video(LARGE, 3, 2)]
        ).read_bytes()
        for _ in range(300):
            data = bytearray(whole)
            for _ in range(3):
                data[int(rng.integers(len(data)))] = int(rng.integers(256))
            path = tmp_path / "damaged"
            path.write_bytes(data[: int(rng.integers(len(data))) + 1])
            choose_track(path)


def test_a_patched_file_differs_in_the_patches_alone(tmp_path):
    path = tmp_path / "file"
    path.write_bytes(bytes(range(100)))
    with open(path, "rb") as file:
        patched = PatchedFile(file, {10: b"abcd", 98: b"yz"})
        for size in (1, 3, 7, 64, 200):
            assert patched.seek(0) == 0
            read = b"".join(iter(lambda size=size: patched.read(size), b""))
            assert read == bytes(range(10)) + b"abcd" + bytes(range(14, 98)) + b"yz"
        assert patched.seek(-5) == -1
