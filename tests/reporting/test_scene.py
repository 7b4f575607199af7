"""What the page reads from the folders of stages."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from PIL import Image

from pipeline.reporting.scene import _coverage, _curve
from pipeline.runtime.atomic import write_json
from pipeline.runtime.errors import UserError
from pipeline.training.loop.curve import TrainingCurve
from tests.reporting.made import coverage, report
from tests.reporting.test_metrics import run


@pytest.fixture
def train(tmp_path: Path) -> Path:
    folder = tmp_path / "barn" / "train"
    records = [record.values for record in report().curve]
    TrainingCurve(tuple(records)).write(folder)
    record = run(9.0, curve_seconds=[record.seconds for record in report().curve])
    write_json(folder / "run.json", record.model_dump(mode="json"))
    return folder


def test_the_curve_has_the_times_of_its_run(train: Path) -> None:
    assert _curve(train) == report().curve


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[]", "a record for each of the 2 times in run.json, found 0 records"),
        ('[{"step": 1, "loss"', "expected TrainingCurve .* EOF"),
        ('[{"step": 1, "loss": 2, "psnr": 3}]', "0.num_gaussians: Field required"),
    ],
)
def test_a_damaged_curve_is_one_error(train: Path, text: str, message: str) -> None:
    (train / "curve.json").write_text(text)
    with pytest.raises(UserError, match=f"curve.json: .*{message}") as caught:
        _curve(train)
    assert "--forcerun train" in str(caught.value)


@pytest.fixture
def measured(tmp_path: Path) -> Path:
    folder = tmp_path / "barn" / "coverage"
    made = coverage()
    made.record.write(folder)
    for name, picture in made.pictures.items():
        (folder / name).parent.mkdir(exist_ok=True)
        Image.fromarray(picture).save(folder / name)
    return folder


def test_coverage_is_read_with_its_pictures(measured: Path) -> None:
    found, made = _coverage(measured), coverage()
    assert found.record == made.record and found.pictures.keys() == made.pictures.keys()


@pytest.mark.parametrize(
    "change",
    [{"schema_version": 2}, {"looked_at": 4}, {"views": [{"name": "0.jpg", "trust": 0.4}]}],
)
def test_coverage_of_another_version_is_one_error(measured: Path, change: dict) -> None:
    file = measured / "coverage.json"
    write_json(file, json.loads(file.read_text()) | change)
    with pytest.raises(UserError, match=f"coverage.json: .*{next(iter(change))}") as caught:
        _coverage(measured)
    assert "--forcerun coverage" in str(caught.value)
