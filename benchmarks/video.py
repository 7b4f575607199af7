"""Sharpness of the frames chosen of videos, beside that of as many evenly spaced ones.

``--frames FOLDER`` writes both sets as scenes, ``<video>-chosen`` and ``<video>-even``, to compare
what is trained on them.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.measured import add_record_options, measured, write_record
from benchmarks.results import VideoFrames
from pipeline.config.schema import Video
from pipeline.io.videofile import opened_video, read_video_facts
from pipeline.photos.video import choose_all, measure
from pipeline.scene.manifest import VideoFile


def compare(path: Path, max_frames: int, frames: Path | None) -> VideoFrames:
    """Compare the choice of at most ``max_frames`` frames of a video with evenly spaced frames."""
    facts = read_video_facts(path)
    video = VideoFile(name=path.stem, path=str(path), **facts.model_dump())
    found = measure(video)
    total = len(found.motion)
    chosen = choose_all([found], max_frames)[1][0]
    even = np.linspace(0, total - 1, len(chosen)).round().astype(int).tolist()
    return VideoFrames(
        video=path.name,
        frames=total,
        chosen=len(chosen),
        chosen_sharpness=_sharpness(path, chosen, frames and frames / f"{path.stem}-chosen"),
        even_sharpness=_sharpness(path, even, frames and frames / f"{path.stem}-even"),
    )


def _sharpness(path: Path, numbers: Sequence[int], scene: Path | None) -> float:
    """Median over frames of the variance of the Laplacian at full resolution; writes the frames as
    photographs of a scene if it is not None."""
    values = []
    with opened_video(path) as capture:
        for number in range(max(numbers) + 1):
            good, frame = capture.read()
            if not good or number not in numbers:
                continue
            picture: NDArray[np.uint8] = np.asarray(frame, np.uint8)
            grey = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
            values.append(float(np.var(cv2.Laplacian(grey, cv2.CV_64F))))
            if scene is not None:
                (scene / "images").mkdir(parents=True, exist_ok=True)
                cv2.imwrite(str(scene / "images" / f"{number:06d}.png"), picture)
    return float(np.median(values))


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.video", description=__doc__)
    parser.add_argument("videos", nargs="+", type=Path, metavar="VIDEO")
    parser.add_argument("--max-frames", type=int, default=Video().max_frames)
    parser.add_argument("--frames", type=Path, metavar="FOLDER", help="write both sets of frames")
    add_record_options(parser)
    options = parser.parse_args(arguments)
    results = [compare(path, options.max_frames, options.frames) for path in options.videos]
    print(json.dumps([asdict(result) for result in results], indent=2))
    if options.json is not None:
        write_record(options.json, measured("video", options.note, arguments), results)


if __name__ == "__main__":
    main()
