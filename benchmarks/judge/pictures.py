"""Cases with images: rendered ones, and photographs from a folder, matched as by the pipeline."""

from __future__ import annotations

import contextlib
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pipeline.config.schema import Config
from pipeline.config.settled import Matches, Sfm
from pipeline.io.posefiles import truth_folder
from pipeline.plan.scan import scan
from pipeline.plan.settle import settle
from pipeline.runtime.errors import UserError
from pipeline.runtime.isolate import run_isolated
from pipeline.runtime.record import read_stage
from pipeline.scene.manifest import Manifest
from pipeline.sfm.continuity import Names, sequence_steps
from pipeline.sfm.features import extract_features
from pipeline.sfm.mappers import Mapper
from pipeline.sfm.second_look import SecondLook

Look = Literal["as_it_is", "bare", "blurred"]
PICTURES: dict[str, Look] = {
    "pictures": "as_it_is",
    "pictures_bare": "bare",
    "pictures_blurred": "blurred",
}
VIEWS, WIDTH, HEIGHT = 14, 320, 240
# The sigma of the blur, pixels, at a width of 320.
BLUR = 5.0


@dataclass(frozen=True)
class Matched:
    """The database of a scene with the options of mapping from its plan."""

    database: Path
    total: int
    mapper: Mapper
    min_share: float
    truth: Path | None
    steps: tuple[Names, ...] = ()


def write_pictures(name: str, seed: int, folder: Path) -> None:
    """Render a case of ``PICTURES``: the demo scene, unchanged, without texture, or blurred."""
    # This runs in a separate process, because cv2 and pycolmap conflict.
    import cv2
    import numpy as np
    from PIL import Image

    from pipeline.demo.cameras import lens, orbit
    from pipeline.demo.render import rays, render
    from pipeline.demo.scene import OBJECTS
    from pipeline.demo.sensor import srgb, to_bytes
    from pipeline.io.colmap import write_model
    from pipeline.scene.reconstruction import Reconstruction

    look = PICTURES[name]
    names = [f"view_{i:03d}.png" for i in range(VIEWS)]
    # The views are on an arc: on a full ring, the same number would be too far apart.
    views = orbit(names, seed)
    camera = lens("simple_radial", WIDTH, HEIGHT)
    through = rays(camera)
    (folder / "images").mkdir(parents=True)
    rng = np.random.default_rng([seed, 5])
    for posed in views:
        light = render(posed, camera, through, OBJECTS).light
        if look == "blurred":
            light = np.asarray(cv2.GaussianBlur(light, (0, 0), BLUR), np.float64)
        if look == "bare":
            # The blur removes the texture; shading and edges remain.
            light = np.asarray(cv2.GaussianBlur(light, (0, 0), 12.0), np.float64) * 0.2 + 0.3
        noisy = srgb(light) + rng.normal(0, 0.004, light.shape)
        Image.fromarray(to_bytes(noisy)).save(folder / "images" / posed.name)
    truth = Reconstruction({1: camera}, {i + 1: posed for i, posed in enumerate(views)})
    write_model(folder / "sparse_gt", truth, text=True)


def match_folder(folder: Path, work: Path, seed: int) -> Matched:
    """The features and matches of the photographs of a scene, by its plan, without its given poses;
    or those of a finished scene (``results/NAME``)."""
    if (folder / "plan.json").is_file():
        return _finished(folder, work)
    config = Config(poses="ignore", seed=seed)
    found = scan(folder, folder.name, config, cache=None)
    settled = settle(found, config).config
    manifest = found.manifest
    features = work / "features"
    extract_features(manifest, settled.features, features, cache=work / "cache", threads=1)
    look = SecondLook(settled.features, work / "cache", work / "more_features")
    run_isolated(_match, manifest, features, settled.matches, settled.sfm, work, seed, look)
    mapper = settled.sfm.mapper
    assert mapper != "auto"
    return Matched(
        work / "database.db",
        len(manifest.photos),
        mapper,
        settled.sfm.min_registered_share,
        truth_folder(folder),
        tuple(sequence_steps(manifest.photos)),
    )


def _finished(folder: Path, work: Path) -> Matched:
    config = read_stage(folder / "sfm").key["config"]["sfm"]
    database = work / "database.db"
    shutil.copyfile(folder / "matches" / "database.db", database)
    truth = folder / "inspect" / "truth"
    photos = Manifest.read(folder / "inspect" / "images.json").photos
    return Matched(
        database,
        len(photos),
        config["mapper"],
        config["min_registered_share"],
        truth if truth.is_dir() else None,
        tuple(sequence_steps(photos)),
    )


def _match(
    manifest: Manifest,
    features: Path,
    matches: Matches,
    sfm: Sfm,
    work: Path,
    seed: int,
    look: SecondLook,
) -> None:
    from pipeline.sfm.matching import MatchingScene, match_features

    # This stage raises an error if no pair is verified. Mapping then finds no model.
    with contextlib.suppress(UserError):
        scene = MatchingScene(manifest, features, sfm, seed)
        database, cache = work / "database.db", work / "cache"
        match_features(scene, matches, database, cache=cache, look=look)
