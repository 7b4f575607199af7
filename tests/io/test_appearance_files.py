"""The files of a scene's appearance: read as they were written, and checked."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.io.appearance_files import COLORS, read_appearance, write_appearance
from pipeline.io.arrays import write_arrays
from pipeline.runtime.errors import UserError
from pipeline.scene.appearance import Appearance

APPEARANCE = Appearance(
    np.arange(30, dtype=np.float32).reshape(5, 2, 3) / 7,
    {"a.jpg": np.array([1 / 3, -0.1]), "b.jpg": np.array([-1 / 3, 0.1])},
)


@pytest.mark.parametrize("gains", [{}, {"a.jpg": np.ones(3), "b.jpg": np.array([0.5, 2, 1 / 3])}])
def test_it_is_read_as_it_was_written(tmp_path: Path, gains: dict[str, np.ndarray]) -> None:
    assert read_appearance(tmp_path, 5) is None
    write_appearance(tmp_path, replace(APPEARANCE, gains=gains))
    found = read_appearance(tmp_path, 5)
    assert found is not None
    assert np.array_equal(found.colors, APPEARANCE.colors)
    assert list(found.embeddings) == ["a.jpg", "b.jpg"]
    for name, values in APPEARANCE.embeddings.items():
        assert np.array_equal(found.embeddings[name], values)
    assert found.gains.keys() == gains.keys()
    for name, values in gains.items():
        assert np.array_equal(found.gains[name], values)


def test_damaged_files_and_those_of_other_scenes_are_errors(tmp_path: Path) -> None:
    write_appearance(tmp_path, APPEARANCE)
    with pytest.raises(UserError, match=r"appearance\.npz: expected colours of 6 Gaussians"):
        read_appearance(tmp_path, 6)
    write_arrays(tmp_path / COLORS, {"colors": np.zeros((5, 3, 3), np.float32)})
    with pytest.raises(UserError, match=r"appearance\.json: expected embeddings of 3 numbers"):
        read_appearance(tmp_path, 5)
    (tmp_path / COLORS).write_bytes(b"no archive")
    with pytest.raises(UserError, match=r"appearance\.npz: expected the appearance of Gaussians"):
        read_appearance(tmp_path, 5)
    (tmp_path / COLORS).unlink()
    with pytest.raises(UserError, match=r"appearance\.npz"):
        read_appearance(tmp_path, 5)
    some = (
        '{"a": {"embedding": [1, 2], "gain": [1, 1, 1]}, "b": {"embedding": [1, 2], "gain": null}}'
    )
    write_appearance(tmp_path, APPEARANCE)
    (tmp_path / "appearance.json").write_text(some)
    with pytest.raises(UserError, match="expected gains of all views or of none"):
        read_appearance(tmp_path, 5)
    (tmp_path / "appearance.json").write_text('{"a.jpg": "x"}')
    with pytest.raises(UserError, match=r"appearance\.json"):
        read_appearance(tmp_path, 5)
