"""Which unit the words about viewpoints to photograph next speak in."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.coverage.measure import world_of
from pipeline.plan.given_poses import GivenModel
from pipeline.scene.manifest import Manifest, Photo
from pipeline.scene.reconstruction import Reconstruction
from pipeline.scene.views import View

MOVED = GivenModel(Reconstruction({}, {}), np.array([1e5, 0.0, 0.0])).georeference()
LEVEL = {"method": "level", "unit": "90% of the cameras lie within 1 of their mean"}


@pytest.mark.parametrize(
    "placed, unit",
    [(None, None), (LEVEL, None), (MOVED, None), ({"method": "gps", "unit": "metres"}, "m")],
)
def test_metres_are_spoken_of_only_where_they_are_known(
    placed: dict[str, object] | None, unit: str | None
) -> None:
    view = View("a.jpg", "a.jpg", None, 4, 3, 4.0, 4.0, 2.0, 1.5, np.eye(4), False)
    photo = Photo(name="a.jpg", path="a.jpg", width=4, height=3, digest="")
    assert world_of([view], Manifest(scene="s", photos=(photo,)), placed).unit == unit
