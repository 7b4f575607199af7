"""Published files fit the JSON schemas in ``docs/schemas/``, by the validator of Snakemake."""

from __future__ import annotations

import json
from pathlib import Path

import jsonschema
import numpy as np
import pytest

from pipeline.config import docs
from pipeline.io.frame_json import RenderSettings, describe_frame
from pipeline.plan.given_poses import GivenModel
from pipeline.reporting.acceptance.judge import judge
from pipeline.reporting.acceptance.measured import measured_of
from pipeline.reporting.acceptance.rules import Rules
from pipeline.runtime.json_file import JsonFile
from pipeline.scene.georeference import GeographicOrigin, Georeference, Residual
from pipeline.scene.normalization import Normalization
from pipeline.scene.reconstruction import Reconstruction
from pipeline.sfm.georeference import summary
from pipeline.surface.path import VideoPath, describe_path
from tests.metrics.test_evaluation import ERROR
from tests.reporting.made import coverage, evaluation, gaussians, metrics, ring
from tests.reporting.test_page import NO_SURFACE

GIVEN = GivenModel(
    Reconstruction({}, {}), Normalization(0.1, np.array([1e6, -0.5, 0.1]))
).georeference()
RESIDUALS = tuple(
    Residual(name=f"{i}.jpg", horizontal_m=0.1 * i, vertical_m=-0.2, used=i < 3) for i in range(4)
)
GPS = Georeference(
    method="gps",
    axes="x east, y north, z up",
    unit="metres",
    origin=GeographicOrigin(latitude=47.1, longitude=8.2, altitude=400.0),
    projection=None,
    scale=2.5,
    rotation=np.eye(3).tolist(),
    translation=(1.0, 2.0, 3.0),
    residuals_m=summary(RESIDUALS, 9, 2),
    residuals=RESIDUALS,
)
RENDER = RenderSettings(background=(0.0, 0.0, 0.0), near=0.01, antialias=True)
FILES: list[JsonFile] = [
    evaluation(),
    evaluation().model_copy(update={"pose_error": ERROR}),
    judge(Rules(), measured_of(metrics(), coverage().record)),
    coverage().record,
    NO_SURFACE,
    GPS,
    describe_frame(gaussians(), ring(), np.array([0.0, 0, 1]), RENDER, ["point_cloud.glb"], GPS),
    describe_frame(gaussians(), ring(), np.array([0.0, 0, 1]), RENDER, [], None),
    describe_path(VideoPath(ring(), 30, "")),
    *([GIVEN] if GIVEN is not None else []),
]


def validator(file: JsonFile) -> jsonschema.Draft202012Validator:
    path = docs.SCHEMAS / file.file_name.replace(".json", ".schema.json")
    return jsonschema.Draft202012Validator(json.loads(path.read_text()))


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.file_name)
def test_a_published_file_fits_its_schema(file: JsonFile, tmp_path: Path) -> None:
    file.write(tmp_path)
    stored = json.loads((tmp_path / file.file_name).read_text())
    validator(file).validate(stored)
    assert type(file).read(tmp_path) == file
    for changed in (stored | {"further": 1}, stored | {"schema_version": 2}):
        assert not validator(file).is_valid(changed)
    del stored["schema_version"]
    assert not validator(file).is_valid(stored)


def test_every_field_of_a_published_file_is_described() -> None:
    for path, text in docs.json_schemas().items():
        schema = json.loads(text)
        for part in (schema, *schema.get("$defs", {}).values()):
            for name, field in part.get("properties", {}).items():
                assert "description" in field or "$ref" in field, f"{path.name}: {name}"
