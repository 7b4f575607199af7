"""The unit of length in the descriptions of viewpoints."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.coverage.measure import world_frame
from pipeline.geometry.similarity import Similarity
from pipeline.plan.given_poses import GivenModel
from pipeline.scene.georeference import Georeference
from pipeline.scene.manifest import Manifest, Photo
from pipeline.scene.normalization import Normalization
from pipeline.scene.reconstruction import Reconstruction
from pipeline.scene.views import View
from pipeline.sfm.georeference import WorldFrame

MOVED = GivenModel(
    Reconstruction({}, {}), Normalization(1.0, np.array([1e5, 0.0, 0.0]))
).georeference()
LEVEL, GPS = (
    WorldFrame(method, Similarity(1.0, np.eye(3), np.zeros(3))).georeference()
    for method in ("level", "gps")
)


@pytest.mark.parametrize(
    "georeference, unit",
    [(None, None), (LEVEL, None), (MOVED, None), (GPS, "m")],
)
def test_the_unit_is_metres_only_if_georeferenced(
    georeference: Georeference | None, unit: str | None
) -> None:
    view = View("a.jpg", "a.jpg", None, 4, 3, 4.0, 4.0, 2.0, 1.5, np.eye(4), False)
    photo = Photo(name="a.jpg", path="a.jpg", width=4, height=3, digest="")
    assert world_frame([view], Manifest(scene="s", photos=(photo,)), georeference).unit == unit
