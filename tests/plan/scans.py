"""Scans and plans of folders, for tests."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipeline.config.schema import Config
from pipeline.io.colmap import read_model, write_model
from pipeline.plan.scan import Scan, scan
from pipeline.plan.values import Plan
from pipeline.scene.reconstruction import Points, Reconstruction
from tests.pictures import photos
from tests.plan.test_scan import write_sparse
from tests.plans import make_plan


def look(folder: Path, **sections) -> Scan:
    return scan(folder, folder.name, Config.model_validate(sections), cache=None)


def plan_of(folder: Path, **sections) -> Plan:
    return make_plan(look(folder, **sections), Config.model_validate(sections))


def many(folder: Path, count: int, **changes) -> Scan:
    """A scan of ``count`` photographs made from two files; ``changes`` map a field of Photo to a
    function of the index."""
    photos(folder / "images", 2)
    few = look(folder)
    pictures = tuple(
        few.photos[0].model_copy(
            update={
                "name": f"p{i:04d}.jpg",
                **{field: value(i) for field, value in changes.items()},
            }
        )
        for i in range(count)
    )
    return few.model_copy(update={"manifest": few.manifest.model_copy(update={"photos": pictures})})


def posed(folder: Path, *, tracks: int, size: tuple[int, int] = (64, 48), count: int = 5) -> Path:
    """Photographs of 64 x 48 pixels, and a model of ``size`` with ``tracks`` points, each observed
    in all images."""
    names = [path.name for path in photos(folder / "images", count)]
    sparse = folder / "sparse" / "0"
    write_sparse(sparse, names, size)
    model = read_model(sparse)
    points = Points(
        np.zeros((tracks, 3)),
        np.zeros((tracks, 3), np.uint8),
        np.zeros(tracks),
        np.arange(tracks + 1) * count,
        np.tile(model.points.track_image_id, tracks),
        np.tile(model.points.track_xy, (tracks, 1)),
    )
    write_model(sparse, Reconstruction(model.cameras, model.images, points))
    return folder
