"""The formats for which multi-view stereo runs."""

from __future__ import annotations

import pytest

from pipeline.config.export import Export


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"formats": ["ply"]}, []),
        ({"formats": ["ply", "mesh"]}, ["mesh"]),
        ({"formats": ["mesh"], "region": "subject"}, []),
        ({"formats": ["dense_maps", "mesh"], "region": "subject"}, ["dense_maps"]),
    ],
)
def test_a_mesh_needs_depths_of_stereo_unless_it_is_of_a_region(options, expected):
    assert Export.model_validate(options).dense_formats == expected
