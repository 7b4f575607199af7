"""The videos of a scene folder, and the number of their frames that the plan expects."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Sequence
from pathlib import Path, PurePosixPath

from pipeline.io.folders import videos_in
from pipeline.io.videofile import VideoFacts, read_video_facts
from pipeline.plan.scene_folder import SceneFolder
from pipeline.scene.manifest import Photo, VideoFile

# The name of a folder of videos beside images/.
VIDEO_FOLDER = "videos"
# The largest number of unused streams that the plan names.
SHOWN_STREAMS = 4


def find_videos(folder: Path, image_folder: str, *, recursive: bool) -> list[str]:
    """The sorted names of the videos in the scene folder itself, in the folder of the photographs
    and in ``videos/``, relative to the scene folder.

    Args:
        folder: The scene folder.
        image_folder: The folder of the photographs, relative to ``folder``.
        recursive: Whether to search all subfolders of the scene folder.
    """
    names = set(videos_in(folder, recursive=recursive))
    for place in {image_folder, VIDEO_FOLDER} - {"."}:
        if (folder / place).is_dir():
            names |= {f"{place}/{name}" for name in videos_in(folder / place)}
    return sorted(names)


def read_videos(
    at: SceneFolder, names: Sequence[str], photos: Collection[str]
) -> tuple[VideoFile, ...]:
    """The videos whose header can be read; each of the others adds a warning.

    Args:
        names: The files, relative to the scene folder.
        photos: The names of the photographs, which the names of frames must differ from.
    """
    found: dict[str, VideoFacts] = {}
    for name in names:
        facts = at.cache.read(at.path / name, "video", VideoFacts, read_video_facts)
        if isinstance(facts, str):
            at.warnings.append(f"{name}: left out: {facts}")
        else:
            found[name] = facts
            at.warnings.extend(f"{name}: {text}" for text in _doubts(facts))
    taken = {str(parent) for photo in photos for parent in PurePosixPath(photo).parents}
    stems = {name: str(PurePosixPath(name).with_suffix("")) for name in found}
    count = Counter(stems.values())
    return tuple(
        VideoFile(
            name=stem if count[stem] == 1 and stem not in taken else name,
            path=str(at.path / name),
            **found[name].model_dump(),
        )
        for name, stem in stems.items()
    )


def _doubts(facts: VideoFacts) -> list[str]:
    """The properties that make a video less useful although it can be read."""
    found = []
    if facts.truncated:
        found.append("its end is missing: the file is shorter than its header says; copy it again")
    if any(0 in size for size in facts.others):
        found.append(
            f"{len(facts.others) + 1} video streams, of which the first is used, because the "
            "header does not say their sizes; if it is not the right one, export the other as a "
            "video of its own"
        )
    elif facts.alike > 1:
        found.append(
            f"{facts.alike} video streams of the same size, of which one is used; if they are of "
            "several lenses, export each as a video of its own"
        )
    return found


def contents(photos: int, videos: int) -> str:
    """The numbers of photographs and videos, in words: "12 photographs, 1 video"."""
    counted = [f"{photos} photographs"] if photos or not videos else []
    if videos:
        counted.append("1 video" if videos == 1 else f"{videos} videos")
    return ", ".join(counted)


def description(video: VideoFile) -> str:
    """The number of frames, size and length of a video according to its header, in words."""
    count = video.frames or "an unknown number of"
    length = f", {video.frames / video.fps:.0f} s" if video.frames and video.fps else ""
    largest = ""
    if any(0 in size for size in video.others):
        largest = f"; the first of {len(video.others) + 1} video streams"
    elif video.others:
        sizes = ", ".join(f"{width}x{height}" for width, height in video.others[:SHOWN_STREAMS])
        more = ", ..." if len(video.others) > SHOWN_STREAMS else ""
        largest = (
            f"; the largest of {len(video.others) + 1} video streams (not used: {sizes}{more})"
        )
    return f"{video.name}: {count} frames of {video.width}x{video.height}{length}{largest}"


def planned_frames(videos: Sequence[VideoFile], max_frames: int) -> tuple[Photo, ...]:
    """Placeholders for the frames that the decode stage may choose: at most ``max_frames``, at
    least one of each video, shared in proportion to the numbers of frames."""
    available = [video.frames or max_frames for video in videos]
    share = min(1.0, max_frames / max(sum(available), 1))
    return tuple(
        Photo(
            name=video.frame_name(index),
            path=video.path,
            width=video.width,
            height=video.height,
            digest=video.digest,
            camera_group=video.camera_group,
        )
        for video, frames in zip(videos, available, strict=True)
        for index in range(max(1, int(share * frames)))
    )
