"""Configuration: what is validated, merged and documented."""

import pytest
import yaml

from pipeline.config import docs
from pipeline.config.load import load_project, merge, scene_config
from pipeline.config.presets import PRESETS
from pipeline.config.schema import Config
from pipeline.runtime.errors import UserError


@pytest.mark.parametrize(
    ("raw", "named"),
    [
        ({"trian": {"steps": 1}}, "trian: no such option (did you mean train?)"),
        ({"train": {"stps": 1}}, "train.stps: no such option (did you mean steps?)"),
        ({"train": {"steps": 0}}, "train.steps"),
        ({"train": {"lr_means": float("nan")}}, "train.lr_means"),
        ({"scenes": {"fox": {"exprt": {}}}}, "scenes.fox: exprt"),
        ({"preset": "quick"}, "preset"),
        ({"matches": {"pairs": "all"}}, "matches.pairs"),
    ],
)
def test_a_wrong_option_is_named(raw, named):
    with pytest.raises(UserError, match="not valid") as caught:
        load_project(raw)
    assert named in str(caught.value)


def test_scene_options_win_over_project_over_preset():
    raw = {
        "preset": "fast",
        "train": {"steps": 50, "density": {"interval": 7}},
        "scenes": {"fox": {"train": {"steps": 60}}},
    }
    fox, other = scene_config(raw, "fox"), scene_config(raw, "other")
    assert (fox.train.steps, other.train.steps) == (60, 50)
    assert fox.train.density.interval == 7
    fast = PRESETS["fast"]["train"]["density"]["max_gaussians"]
    assert fox.train.density.max_gaussians == fast


def test_numbers_that_arrive_as_text_are_numbers():
    assert scene_config({"train": {"steps": "100"}}, "x").train.steps == 100


@pytest.mark.parametrize("preset", ["fast", "balanced", "high"])
def test_presets_are_valid_and_keep_the_defaults_of_the_rest(preset):
    config = scene_config({"preset": preset}, "x")
    assert config.preset == preset
    assert config.export == Config().export


def test_merge_leaves_its_arguments_alone():
    base = {"a": {"b": 1}}
    assert merge(base, {"a": {"c": 2}}) == {"a": {"b": 1, "c": 2}}
    assert base == {"a": {"b": 1}}


def test_generated_page_and_defaults_are_current():
    assert docs.PAGE.read_text() == docs.page(), "run make docs"
    assert docs.DEFAULTS.read_text() == docs.defaults(), "run make docs"


def test_uncommented_defaults_are_the_defaults():
    """The commented YAML must say what the program does when it is left alone."""
    text = docs.defaults()
    lines = [line.removeprefix("# ") for line in text.splitlines()[2:]]
    values = yaml.safe_load("\n".join(lines))
    values.pop("data_root")
    values.pop("scenes")
    assert Config.model_validate(values) == Config()
