"""``evaluation.json``, as evaluate writes and coverage and report read it."""

import json
from pathlib import Path

import pytest

from pipeline.metrics.evaluation import Evaluation
from pipeline.metrics.pose import PoseError
from pipeline.runtime.errors import UserError
from tests.reporting.made import evaluation

ERROR = PoseError(
    rotation_median_deg=0.1,
    rotation_mean_deg=0.2,
    centre_median=None,
    centre_mean=None,
    centre_relative_median=None,
    radius=2.0,
    scale=1.0,
    auc={1.0: 0.5, 10.0: 2 / 3},
    num_common=2,
    num_truth=3,
)


def test_an_evaluation_is_read_as_it_was_written(tmp_path: Path) -> None:
    written = evaluation().model_copy(update={"pose_error": ERROR})
    written.write(tmp_path)
    assert Evaluation.read_for(tmp_path, ["a.jpg", "b.jpg"]) == written
    stored = json.loads((tmp_path / "evaluation.json").read_text())
    assert stored["schema_version"] == 1
    assert stored["pose_error"]["auc"] == {"1.0": 0.5, "10.0": 2 / 3}


def test_an_evaluation_of_another_scene_is_an_error(tmp_path: Path) -> None:
    evaluation().write(tmp_path / "evaluate")
    with pytest.raises(UserError, match=r"found a\.jpg, which it lacks") as caught:
        Evaluation.read_for(tmp_path / "evaluate", ["b.jpg"])
    assert "--forcerun evaluate" in str(caught.value)
