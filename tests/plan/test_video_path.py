"""A camera path that cannot be followed is reported before the training, not after it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from pipeline.runtime.errors import UserError
from stages import export
from tests.io.camera_paths import FRAMES, NERFSTUDIO
from tests.pictures import photos
from tests.plan.scans import plan_of


def planned(folder: Path, path: object, *formats: str):
    photos(folder / "images", 4)
    return plan_of(folder, export={"formats": formats or ("video",), "video": {"path": path}})


def test_chosen_photographs_must_exist(tmp_path: Path) -> None:
    planned(tmp_path / "a", ["p00.jpg", "p03.jpg"])
    planned(tmp_path / "b", ["p00.jpg", "nothing"], "ply")
    with pytest.raises(UserError, match=r"P03\.jpg is not a photograph .* mean p03\.jpg"):
        planned(tmp_path / "c", ["p00.jpg", "P03.jpg"])


def test_a_file_is_read_before_the_run_and_its_content_belongs_to_the_key(tmp_path: Path) -> None:
    file = tmp_path / "walk.json"
    with pytest.raises(UserError, match="cannot be read"):
        planned(tmp_path / "a", str(file))
    file.write_text(json.dumps(FRAMES))
    first = export.facts(planned(tmp_path / "b", str(file)))
    file.write_text(json.dumps(NERFSTUDIO))
    assert first != export.facts(planned(tmp_path / "c", str(file)))
