"""Frames of HDR, interlaced and anamorphic videos become ordinary photographs."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline.config.schema import Video
from pipeline.io.videofile import opened_video, read_video_facts
from pipeline.photos.load import load_rgb
from pipeline.photos.video import extract_frames, measure
from pipeline.photos.video_frames import first_field, is_combed
from pipeline.scene.manifest import Manifest, VideoFile
from tests.videos import panned, texture, write_video

DATA = Path(__file__).parent / "data"


@pytest.mark.parametrize("transfer", ["hlg", "pq"])
def test_hdr_video_looks_like_its_source(transfer):
    """The files show one picture: x265 of ffmpeg 5.1, 10 bits, BT.2020, white at 203 cd/m^2."""
    frames = []
    for name in ("sdr", transfer):
        with opened_video(DATA / f"{name}.mov") as capture:
            frames.append(capture.read()[1].astype(float))
    source, converted = frames
    assert np.abs(converted - source).mean() < 12
    assert np.corrcoef(source.ravel(), converted.ravel())[0, 1] > 0.98


def interlaced(frames: list[np.ndarray]) -> list[np.ndarray]:
    woven = []
    for first, second in zip(frames[::2], frames[1::2], strict=True):
        frame = first.copy()
        frame[1::2] = second[1::2]
        woven.append(frame)
    return woven


def test_interlaced_videos_are_recognised_and_one_field_is_used(tmp_path):
    # Grey: the encoder mixes the colours of both fields.
    progressive = [np.repeat(f[..., :1], 3, axis=2) for f in panned(range(0, 240, 3))]
    woven = interlaced(progressive)
    assert sum(map(is_combed, woven)) > 0.8 * len(woven)
    assert not any(map(is_combed, progressive))
    for name, frames, expected in (("a", woven, True), ("b", progressive, False)):
        path = write_video(tmp_path / f"{name}.avi", frames)
        video = VideoFile(name=name, path=str(path), **read_video_facts(path).model_dump())
        assert measure(video).interlaced is expected
        manifest = Manifest(scene="s", photos=(), videos=(video,))
        report = extract_frames(manifest, Video(), tmp_path / name, threads=1)
        assert ("one field is used" in report.decisions[0]) is expected
        if expected:
            for photo in report.manifest.photos[:5]:
                number = int(Path(photo.name).stem)
                field, weave = load_rgb(photo.path), woven[number][..., ::-1]
                truth = progressive[2 * number][..., ::-1].astype(int)
                assert np.abs(field - truth).mean() < 0.6 * np.abs(weave - truth).mean()


def test_a_field_is_interpolated_without_a_shift():
    picture = texture(1, (200, 100))
    smooth = cv2.GaussianBlur(picture, (0, 0), 3)
    error = first_field(smooth).astype(int) - smooth
    assert np.abs(error[4:-4]).max() <= 3


def test_frames_get_square_pixels(tmp_path):
    """The ratio is in the headers of Matroska, which FFmpeg reads: DisplayWidth over PixelWidth."""
    path = write_video(tmp_path / "a.mkv", panned(range(0, 100, 4)))
    video = VideoFile(name="a", path=str(path), **read_video_facts(path).model_dump())
    wide = video.model_copy(update={"width": 2 * video.width})
    manifest = Manifest(scene="s", photos=(), videos=(wide,))
    report = extract_frames(manifest, Video(), tmp_path / "out", threads=1)
    photo = report.manifest.photos[0]
    assert (photo.width, photo.height) == (320, 120)
    assert load_rgb(photo.path).shape == (120, 320, 3)
