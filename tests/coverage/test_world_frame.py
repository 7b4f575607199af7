"""The unit of length in the descriptions of viewpoints."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.coverage.measure import world_frame
from pipeline.plan.given_poses import GivenModel
from pipeline.scene.manifest import Manifest, Photo
from pipeline.scene.reconstruction import Reconstruction
from pipeline.scene.views import View

MOVED = GivenModel(Reconstruction({}, {}), np.array([1e5, 0.0, 0.0])).georeference()
LEVEL = {"method": "level", "unit": "90% of the cameras lie within 1 of their mean"}


@pytest.mark.parametrize(
    "georeference, unit",
    [(None, None), (LEVEL, None), (MOVED, None), ({"method": "gps", "unit": "metres"}, "m")],
)
def test_the_unit_is_metres_only_if_georeferenced(
    georeference: dict[str, object] | None, unit: str | None
) -> None:
    view = View("a.jpg", "a.jpg", None, 4, 3, 4.0, 4.0, 2.0, 1.5, np.eye(4), False)
    photo = Photo(name="a.jpg", path="a.jpg", width=4, height=3, digest="")
    assert world_frame([view], Manifest(scene="s", photos=(photo,)), georeference).unit == unit
