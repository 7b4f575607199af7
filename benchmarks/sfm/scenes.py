"""Measured scenes with known poses, and the configurations that the plan can choose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from itertools import product
from pathlib import Path

from pipeline.config.load import scene_config
from pipeline.config.presets import PRESETS
from pipeline.config.settled import Config
from pipeline.io.colmap import read_model
from pipeline.io.names import NameIndex
from pipeline.photos.verify import verify_photos
from pipeline.plan.given_poses import load_given
from pipeline.plan.scan import Scan, scan
from pipeline.plan.settle import settle
from pipeline.runtime.errors import UserError
from pipeline.scene.manifest import Manifest
from pipeline.scene.reconstruction import Reconstruction

MAPPERS = ("incremental", "global")
PAIRS = ("exhaustive", "sequential", "spatial", "retrieval")


@dataclass(frozen=True)
class Scene:
    """Photographs and their true poses.

    Attributes:
        scan: The scan of the photographs to be used, as if no poses were given.
        truth: The poses of these photographs alone.
        truth_kind: Either "truth" (``sparse_gt``) or "given poses", themselves a reconstruction.
    """

    name: str
    scan: Scan
    truth: Reconstruction
    truth_kind: str

    @property
    def manifest(self) -> Manifest:
        return self.scan.manifest


@dataclass(frozen=True)
class Configuration:
    """``name`` is preset/mapper/pairs. ``planned`` is True for the plan's choice for the scene."""

    name: str
    config: Config
    planned: bool


def load_scene(folder: Path, every: int = 1) -> Scene:
    """The scene in ``folder``, with every ``every``-th photograph, sorted by name.

    Raises:
        UserError: The folder has no poses to measure against.
    """
    name = folder.resolve().name
    found = scan(folder, name, Config(poses="ignore"), cache=None)
    if found.truth is not None:
        truth, kind = read_model(found.truth), "truth"
    else:
        given = scan(folder, name, Config(), cache=None)
        if given.poses is None:
            raise UserError(
                "has no poses to measure against",
                file=folder,
                fix="bring them as sparse_gt/, sparse/0 or transforms.json",
            )
        model = load_given(
            folder / given.poses.path,
            given.poses.kind,
            given.photos,
            listed=given.listed,
            base_folder=given.base_folder,
        ).model
        truth, kind = model, "given poses"
    manifest, _ = verify_photos(found.manifest, threads=1, min_photos=2)
    photos = sorted(manifest.photos, key=lambda photo: photo.name)[::every]
    manifest = manifest.model_copy(update={"photos": tuple(photos)})
    used = NameIndex({photo.name: photo for photo in photos})
    images = {i: v for i, v in truth.images.items() if used.find(v.name) is not None}
    scanned = found.model_copy(update={"manifest": manifest})
    return Scene(name, scanned, replace(truth, images=images), kind)


def configurations(scene: Scene, patterns: Sequence[str]) -> list[Configuration]:
    """The configurations that match one of the ``patterns`` (``*`` matches anything; "plan" matches
    the choice of the plan for each preset)."""
    possible = [
        pairs
        for pairs in PAIRS
        if not (pairs == "sequential" and scene.scan.ordered is None)
        and not (pairs == "spatial" and scene.scan.num_gps < len(scene.manifest.photos))
    ]
    found = []
    for preset in PRESETS:
        chosen = _settled(scene, preset, "auto", "auto")
        for mapper, pairs in product(MAPPERS, possible):
            planned = (chosen.sfm.mapper, chosen.matches.pairs) == (mapper, pairs)
            name = f"{preset}/{mapper}/{pairs}"
            if any(fnmatchcase(name, p) or (p == "plan" and planned) for p in patterns):
                found.append(Configuration(name, _settled(scene, preset, mapper, pairs), planned))
    return found


def _settled(scene: Scene, preset: str, mapper: str, pairs: str) -> Config:
    """The plan of the scene with these options, with poses from structure from motion."""
    raw = {"preset": preset, "matches": {"pairs": pairs}, "sfm": {"mapper": mapper}}
    return settle(scene.scan, scene_config({**raw, "poses": "ignore"}, scene.name)).config
