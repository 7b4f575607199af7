"""Digests of the files of a scene."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from pipeline.io.fact_cache import FactCache
from pipeline.io.posefiles import GivenPoses, pose_files
from pipeline.io.recorded import digest_of
from pipeline.scene.manifest import Manifest, Photo, VideoFile


def digest_of_files(folder: Path, files: Sequence[Path], cache: FactCache) -> str:
    lines = []
    for path in files:
        lines.append(f"{path.relative_to(folder).as_posix()}\0{cached_digest(path, cache)}")
    return hashlib.blake2b("\n".join(sorted(lines)).encode(), digest_size=16).hexdigest()


def cached_digest(path: Path, cache: FactCache) -> str:
    return cache.get(path, "digest", str, partial(digest_of, path))


def fingerprint_of(
    folder: Path,
    manifest: Manifest,
    listed: Sequence[str],
    poses: GivenPoses | None,
    control: Path | None,
    clouds: Sequence[Path],
    cache: FactCache,
) -> str:
    photos = manifest.photos
    files: list[Photo | VideoFile] = [*photos, *manifest.videos]
    others = [Path(p) for photo in photos for p in (photo.mask, photo.depth) if p is not None]
    if poses is not None:
        others += pose_files(folder / poses.path, poses.kind)
    if control is not None:
        others.append(control)
    others += clouds
    lines = [f"{Path(p.path).relative_to(folder).as_posix()}\0{p.digest}" for p in files]
    # Unreadable files are included by name, because warnings mention them.
    lines += [*listed, digest_of_files(folder, others, cache)]
    return hashlib.blake2b("\n".join(lines).encode(), digest_size=16).hexdigest()
