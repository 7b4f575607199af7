"""Choosing frames of videos by motion and sharpness, and writing them as photographs.

Consecutive frames of a video show almost the same. A frame is chosen for each step of motion of the
image: a slow camera gives few frames per second, a fast one many, a standing one a single frame.
Of the frames near each step a sharp one is chosen: frames of a moving camera are often blurred.

A video is decoded twice, one frame at a time: once at reduced size to measure all frames, once to
write the chosen ones.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.config.schema import Video
from pipeline.io.recorded import digest_of
from pipeline.io.videofile import opened_video
from pipeline.photos.encode import write_picture
from pipeline.photos.video_frames import FrameFormat, is_combed
from pipeline.runtime.errors import ChangedFileError, UserError
from pipeline.runtime.progress import Progress
from pipeline.scene.manifest import Manifest, Photo, VideoFile

# The long side in pixels at which frames are measured: it shows blur that a photograph at training
# resolution shows, and hardly any noise and compression artefacts.
MEASURED_PX = 320
# The motion between chosen frames as a share of the long side. Neighbours overlap by 95 %, so that
# features are matched over several frames; larger steps lose frames of cameras that turn quickly.
STEP = 0.05
# A video is interlaced from this share of combed frames: where nothing moves, none are.
COMBED_SHARE = 0.2
INTERLACED = "; of interlaced frames one field is used"
# With fewer frames than this the step is lowered, down to MIN_STEP: one pixel of MEASURED_PX, below
# which motion cannot be told from noise; and not so far that blurred frames are chosen, whose mean
# log2 of the largest sharpness within half of STEP over their own exceeds MAX_BLUR.
FEW_FRAMES, MIN_STEP, MAX_BLUR = 60, 0.003, 0.25
# The smallest and largest distance between chosen frames in steps: neighbours show different
# images, and overlap.
MIN_GAP, MAX_GAP = 0.3, 2.0
# The number of parts of a step. The sharpest frame of each part is a candidate.
CELLS = 8
# Motion is measured from an anchor frame, which is replaced after this share of the long side:
# errors of tracking do not add up while the camera stands.
ANCHOR = 0.02
# The percentile of the corners' displacements that counts as motion of the image: around a centred
# subject most of the image hardly moves, and a smaller part may be people or cars.
PERCENTILE = 80
# A frame in which less than a third of the corners are found again shows something else, at least
# as far away as this share of the long side.
TRACKED_SHARE, JUMP = 1 / 3, 0.25
MAX_CORNERS, MIN_CORNERS = 100, 12
# The largest distance in pixels of a corner from its place when it is tracked back.
MAX_BACKWARD_ERROR = 1.0
# A file in which fewer frames than this share of the stored ones can be decoded is damaged.
COMPLETE = 0.8


@dataclass(frozen=True)
class Measured:
    """The measurements of all frames of a video.

    Attributes:
        motion: (N,) accumulated motion of the image from the first frame, as a share of its long
            side, which does not decrease.
        sharpness: (N,) variances of the Laplacian, comparable between similar frames only.
        interlaced: Whether even and odd rows were recorded one after the other.
    """

    motion: NDArray[np.float64]
    sharpness: NDArray[np.float64]
    interlaced: bool = False


@dataclass(frozen=True)
class FramesReport:
    """The result of ``extract_frames``.

    Attributes:
        manifest: The manifest with the chosen frames as photographs, without videos.
        chosen, total: The numbers of chosen and of decoded frames, by the video's name.
        decisions, warnings: Sentences for the log.
    """

    manifest: Manifest
    chosen: dict[str, int]
    total: dict[str, int]
    decisions: tuple[str, ...]
    warnings: tuple[str, ...]


def extract_frames(
    manifest: Manifest, config: Video, out: Path, *, threads: int, min_photos: int = 1
) -> FramesReport:
    """Write chosen frames of the videos to ``out/images/<video>/<frame>.png``, and
    ``out/images.json``.

    The files are PNG: frames have been compressed once, and a second lossy compression would add
    errors of its own. The rotation in a video's header is applied. The number of threads does not
    change the result.

    Args:
        min_photos: The smallest number of photographs and chosen frames.

    Raises:
        UserError: There are fewer than ``min_photos`` photographs and frames, or a video has
            changed since it was scanned.
    """
    before = cv2.getNumThreads()
    cv2.setNumThreads(max(threads, 1))
    try:
        measured = {video: measure(video, threads) for video in manifest.videos}
    finally:
        cv2.setNumThreads(before)
    step, chosen = choose_all(list(measured.values()), config.max_frames)
    photos = list(manifest.photos)
    decisions, warnings = [], []
    for (video, found), frames in zip(measured.items(), chosen, strict=True):
        stored = FrameFormat((video.width, video.height), found.interlaced)
        photos += _write_frames(video, frames, stored, out / "images", threads)
        total = len(found.motion)
        decisions.append(
            f"{video.name}: {len(frames)} of {total} frames chosen: the sharpest for each "
            f"{step:.1%} of its long side that the image moves, {found.motion[-1]:.1f} times the "
            "long side in all" + (INTERLACED if found.interlaced else "")
        )
        if video.counted and total < COMPLETE * video.frames:
            cause = "the end of the file is missing" if video.truncated else "the file is damaged"
            warnings.append(
                f"{Path(video.path).name}: {total} frames can be decoded, its header says "
                f"{video.frames}: {cause}; copy it again"
            )
    if len(photos) < min_photos:
        raise UserError(
            f"only {len(photos)} frames were chosen of {len(measured)} videos, at least "
            f"{min_photos} are needed: the camera hardly moves",
            file=Path(manifest.videos[0].path),
            fix="record while walking around the scene, slowly and without turning on the spot",
        )
    manifest = manifest.model_copy(
        update={
            "photos": tuple(sorted(photos, key=lambda photo: photo.name)),
            "videos": (),
            "warnings": (*manifest.warnings, *warnings),
        }
    )
    manifest.write(out / "images.json")
    return FramesReport(
        manifest,
        {video.name: len(frames) for video, frames in zip(measured, chosen, strict=True)},
        {video.name: len(found.motion) for video, found in measured.items()},
        tuple(decisions),
        tuple(warnings),
    )


# --- choice -------------------------------------------------------------------------------


def choose_all(videos: Sequence[Measured], max_frames: int) -> tuple[float, list[list[int]]]:
    """The step of motion, and the chosen frames of each video in ascending order.

    The step is ``STEP``, but smaller if that gives few frames, and larger if it gives more than
    ``max_frames``. Each video has at least one frame.
    """

    def chosen(step: float) -> list[list[int]]:
        return [choose_frames(video, step) for video in videos]

    def count(frames: list[list[int]]) -> int:
        return sum(map(len, frames))

    step, frames = STEP, chosen(STEP)
    while count(frames) < min(FEW_FRAMES, max_frames) and step > MIN_STEP:
        smaller = max(step / 1.1, MIN_STEP)
        more = chosen(smaller)
        if _mean_blur(videos, more) > max(MAX_BLUR, _mean_blur(videos, frames)):
            break
        step, frames = smaller, more
    while count(frames) > max(max_frames, len(videos)):
        step *= 1.02
        frames = chosen(step)
    return step, frames


def _mean_blur(videos: Sequence[Measured], chosen: Sequence[Sequence[int]]) -> float:
    blur = []
    for video, frames in zip(videos, chosen, strict=True):
        sharpness = np.log2(np.maximum(video.sharpness, 1e-12))
        starts = np.searchsorted(video.motion, video.motion[frames] - STEP / 2)
        stops = np.searchsorted(video.motion, video.motion[frames] + STEP / 2, "right")
        for frame, start, stop in zip(frames, starts, stops, strict=True):
            blur.append(sharpness[start:stop].max() - sharpness[frame])
    return float(np.mean(blur))


def choose_frames(video: Measured, step: float) -> list[int]:
    """Sharp frames, 0.3 to 2 steps of motion apart, in ascending order.

    They are the path of the smallest cost through the video, found by dynamic programming. The cost
    of a frame is its blur, log2 of the largest sharpness within a step of motion over its own, plus
    the squared deviation of the distance from its predecessor from one step; both are multiplied by
    that distance, so that few frames are not cheaper than many. Distances are larger where the
    image jumps.
    """
    position, frames = _candidates(video, step)
    sharpness = np.log2(np.maximum(video.sharpness[frames], 1e-12))
    blur = np.array(
        [
            sharpness[np.searchsorted(position, p - 1) : np.searchsorted(position, p + 1, "right")]
            .max()
            for p in position
        ]
    ) - sharpness  # fmt: skip
    cost, before = np.zeros(len(frames)), np.full(len(frames), -1)
    for i, p in enumerate(position):
        stop = int(np.searchsorted(position, p - MIN_GAP, "right"))
        if stop == 0:
            cost[i] = blur[i]
            continue
        start = min(int(np.searchsorted(position, p - MAX_GAP)), stop - 1)
        gap = np.minimum(p - position[start:stop], MAX_GAP)
        total = cost[start:stop] + gap * (blur[i] + (gap - 1) ** 2)
        best = int(np.argmin(total))
        cost[i], before[i] = total[best], start + best
    last = int(np.searchsorted(position, position[-1] - MIN_GAP))
    at = last + int(np.argmin(cost[last:]))
    chosen = []
    while at >= 0:
        chosen.append(int(frames[at]))
        at = int(before[at])
    return chosen[::-1]


def _candidates(video: Measured, step: float) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """The positions in steps and the numbers of the sharpest frames of each cell of a step."""
    position = video.motion / step
    cell = np.floor(position * CELLS)
    order = np.lexsort((np.arange(len(cell)), -video.sharpness, cell))
    frames = np.sort(order[np.flatnonzero(np.diff(cell[order], prepend=-1.0))])
    return position[frames], frames


# --- measurement --------------------------------------------------------------------------


def measure(video: VideoFile, threads: int = 1) -> Measured:
    """The motion and sharpness of all frames of a video."""
    tracker = _Tracker()
    motion, sharpness, combed = [], [], 0
    scale = min(1.0, MEASURED_PX / max(video.width, video.height))
    size = max(1, round(scale * video.width)), max(1, round(scale * video.height))
    progress = Progress(f"measuring {video.name}", video.frames, "frames")
    for frame in _frames(Path(video.path), threads):
        if progress.done >= progress.total:  # The header counts too few frames, or none.
            progress.total = progress.done + 2
        # Frames are reduced before they become grey, which is faster than the reverse; frames of
        # another size than the header's become equally large too.
        small = cv2.resize(frame, size, interpolation=cv2.INTER_AREA)
        grey = np.asarray(cv2.cvtColor(small, cv2.COLOR_BGR2GRAY), np.uint8)
        combed += is_combed(frame)
        motion.append(tracker.motion(grey))
        sharpness.append(float(np.var(cv2.Laplacian(grey, cv2.CV_32F), dtype=np.float64)))
        progress.advance()
    if not motion:
        raise UserError("no frame can be decoded", file=Path(video.path), fix="copy it again")
    interlaced = combed >= COMBED_SHARE * len(motion)
    return Measured(np.array(motion), np.array(sharpness), interlaced)


class _Tracker:
    """Accumulates the motion of the image over consecutive frames."""

    def __init__(self) -> None:
        self._anchor: NDArray[np.uint8] | None = None
        self._corners: NDArray[np.float32] | None = None
        self._before = 0.0
        self._motion = 0.0

    def motion(self, grey: NDArray[np.uint8]) -> float:
        """The accumulated motion at the next frame, as a share of the long side."""
        if self._anchor is None or self._corners is None:
            self._set_anchor(grey)
            return self._motion
        pixels = _displacement(self._anchor, grey, self._corners)
        moved = JUMP if pixels is None else pixels / max(grey.shape)
        self._motion = max(self._motion, self._before + moved)
        if moved >= ANCHOR:
            self._set_anchor(grey)
        return self._motion

    def _set_anchor(self, grey: NDArray[np.uint8]) -> None:
        self._before = self._motion
        self._anchor = grey
        corners = cv2.goodFeaturesToTrack(grey, MAX_CORNERS, 0.01, 7)
        # Without texture there is no motion to measure: the next frame becomes the anchor.
        textured = corners is not None and len(corners) >= MIN_CORNERS
        self._corners = np.asarray(corners, np.float32) if textured else None


def _displacement(
    before: NDArray[np.uint8], after: NDArray[np.uint8], corners: NDArray[np.float32]
) -> float | None:
    """The displacement of the corners in pixels (``PERCENTILE``); None if most of them are lost.

    Args:
        before, after: (H, W) grey images.
        corners: (N, 1, 2) pixels in ``before``.
    """
    there, found = _tracked(before, after, corners)
    back, found_back = _tracked(after, before, there)
    error = np.linalg.norm(back - corners, axis=-1)
    good = found & found_back & (error <= MAX_BACKWARD_ERROR)
    if good.sum() < TRACKED_SHARE * len(corners):
        return None
    return float(np.percentile(np.linalg.norm(there - corners, axis=-1)[good], PERCENTILE))


def _tracked(
    before: NDArray[np.uint8], after: NDArray[np.uint8], corners: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """(N, 1, 2) positions of the corners in ``after``, and (N, 1) whether they were found."""
    # OpenCV's stubs do not allow None, which lets it allocate the positions.
    there, found, _ = cv2.calcOpticalFlowPyrLK(before, after, corners, None, maxLevel=4)  # type: ignore[call-overload]
    return there, found == 1


# --- files --------------------------------------------------------------------------------


def _frames(path: Path, threads: int) -> Iterator[NDArray[np.uint8]]:
    """All frames of a video, (H, W, 3) BGR."""
    with opened_video(path, threads) as capture:
        while True:
            good, frame = capture.read()
            if not good:
                return
            yield np.asarray(frame, np.uint8)


def _write_frames(
    video: VideoFile, chosen: Sequence[int], stored: FrameFormat, folder: Path, threads: int
) -> list[Photo]:
    """Write the frames with these numbers, and return their entries in the manifest."""
    wanted = set(chosen)
    photos: list[Photo] = []
    progress = Progress(f"writing frames of {video.name}", len(chosen), "frames")
    with opened_video(Path(video.path), threads) as capture:
        for index in range(max(chosen) + 1):
            # Only the frames that are written are converted to RGB.
            if not capture.grab():
                break
            if index not in wanted:
                continue
            _, frame = capture.retrieve()
            picture = stored.photograph(np.asarray(frame, np.uint8))
            photos.append(_write_frame(video, index, picture, folder))
            progress.advance()
    if digest_of(Path(video.path)) != video.digest or len(photos) != len(chosen):
        raise ChangedFileError(
            "has changed since the scene was inspected",
            file=Path(video.path),
            fix="run the same command again, and leave the scene's files unchanged while it runs",
        )
    return photos


def _write_frame(video: VideoFile, index: int, frame: NDArray[np.uint8], folder: Path) -> Photo:
    name = video.frame_name(index)
    path = folder / name
    write_picture(path, frame)
    height, width = frame.shape[:2]
    return Photo(
        name=name,
        path=str(path),
        width=width,
        height=height,
        digest=digest_of(path),
        camera_group=video.camera_group,
    )
