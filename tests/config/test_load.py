"""Configuration: what is validated, merged and documented."""

import re
from pathlib import Path

import pytest
import yaml

from pipeline.config import docs
from pipeline.config.load import Project, load_project, merge, scene_config
from pipeline.config.presets import PRESETS
from pipeline.config.schema import Config
from pipeline.runtime.errors import UserError


@pytest.mark.parametrize(
    ("raw", "named"),
    [
        ({"trian": {"steps": 1}}, "trian: no such option (did you mean train?)"),
        (
            {"steps": 100},
            "steps: no such option (did you mean train.steps, as in --config 'train={steps: 100}'",
        ),
        ({"train.sh_degre": 1}, "(did you mean train.sh_degree, as in"),
        ({"train": {"stps": 1}}, "train.stps: no such option (did you mean train.steps?)"),
        ({"train": {"steps": 0}}, "train.steps"),
        ({"export": {"video": {"seconds": 0}}}, "export.video.seconds"),
        ({"export": {"video": {"seconds": 1e9}}}, "export.video.seconds"),
        ({"export": {"video": {"fps": 0}}}, "export.video.fps"),
        ({"export": {"video": {"long_side_px": 641}}}, "Input should be even"),
        ({"export": {"video": {"long_side_px": 0}}}, "export.video.long_side_px"),
        ({"export": {"video": {"long_side_px": 100_000}}}, "export.video.long_side_px"),
        ({"export": {"video": {"path": "spiral"}}}, "export.video.path"),
        ({"export": {"video": {"path": ["a.jpg"]}}}, "export.video.path"),
        ({"export": {"video": {"path": 3}}}, "Input should be 'auto', 'orbit' or 'cameras'"),
        ({"train": {"ssim_loss_weight": float("nan")}}, "train.ssim_loss_weight"),
        (
            {"train": {"density": {"max_gausians": 5}}},
            "max_gausians: no such option (did you mean train.density.max_gaussians?)",
        ),
        ({"train": {"density": {"strategy": "none"}}}, "train.density: "),
        (
            {"train": {"density": {"strategy": "original", "remove_floaters": True}}},
            "train.density.remove_floaters: no such option",
        ),
        (
            {"experiments": {"train": {"gradient": {"interval_": 1}}}},
            "interval_: no such option (did you mean experiments.train.gradient.interval?)",
        ),
        ({"scenes": {"fox": {"exprt": {}}}}, "scenes.fox: exprt"),
        ({"preset": "quick"}, "preset"),
        ({"preset": "fastt"}, "found 'fastt' (did you mean fast?)"),
        ({"train": "{steps: 5"}, "{steps: 2000}, found '{steps: 5' (a brace is missing)"),
        ({"configs": ["fsat"]}, "fsat is no preset (did you mean fast?), as fast, balanced"),
        ({"matches": {"pairs": "all"}}, "matches.pairs"),
        ({"configs": ["quick"]}, "quick is no preset"),
        ({"configs": {"a@b": {}}}, "'a@b' cannot name a configuration"),
        ({"configs": {"seed1": {}}}, "'seed1' cannot name a configuration"),
        ({"configs": {"sh0": {"train": {"sh_dgree": 0}}}}, "configs.sh0: train.sh_dgree"),
        ({"seeds": [-1]}, "seeds.0"),
    ],
)
def test_a_wrong_option_is_named(raw, named):
    with pytest.raises(UserError, match="not valid") as caught:
        load_project(raw)
    assert named in str(caught.value)


def test_scene_options_win_over_project_over_preset():
    raw = {
        "preset": "fast",
        "train": {"steps": 50, "density": {"max_gaussians": 7}},
        "scenes": {"fox": {"train": {"steps": 60}}},
    }
    fox, other = scene_config(raw, "fox"), scene_config(raw, "other")
    assert (fox.train.steps, other.train.steps) == (60, 50)
    assert fox.train.density.max_gaussians == 7
    fast = PRESETS["fast"]["train"]["density"]["pixels_per_gaussian"]
    assert fox.train.density.pixels_per_gaussian == fast


def test_a_configuration_wins_over_the_scene_and_brings_its_preset():
    raw = {
        "preset": "balanced",
        "train": {"ssim_loss_weight": 0.3},
        "scenes": {"fox": {"train": {"sh_degree": 2, "depth_loss_weight": 0.5}}},
        "configs": {"plain": {"preset": "fast", "train": {"sh_degree": 0}}},
    }
    plain = scene_config(raw, "fox", "plain", seed=7)
    assert (plain.preset, plain.seed, plain.train.sh_degree) == ("fast", 7, 0)
    assert (plain.train.ssim_loss_weight, plain.train.depth_loss_weight) == (0.3, 0.5)
    assert plain.train.steps == PRESETS["fast"]["train"]["steps"]
    assert scene_config(raw, "fox").train.sh_degree == 2


def test_presets_in_a_list_are_configurations():
    project, _ = load_project({"configs": ["fast", "high"], "seeds": ["0", "1"]})
    assert project.configs == {"fast": {"preset": "fast"}, "high": {"preset": "high"}}
    assert project.seeds == [0, 1]


def test_numbers_that_arrive_as_text_are_numbers():
    assert scene_config({"train": {"steps": "100"}}, "x").train.steps == 100


@pytest.mark.parametrize("preset", list(PRESETS))
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
    assert docs.EXPERIMENTS_PAGE.read_text() == docs.experiments_page(), "run make docs"
    assert docs.DEFAULTS.read_text() == docs.defaults(), "run make docs"
    schemas = docs.json_schemas()
    assert set(docs.SCHEMAS.iterdir()) == set(schemas), "a schema of no file, or none of one"
    for path, text in schemas.items():
        assert path.read_text() == text, "run make docs"


def test_uncommented_defaults_are_the_defaults():
    """The commented YAML must say what the program does when it is left alone."""
    text = docs.defaults()
    lines = [line.removeprefix("# ") for line in text.splitlines()[2:]]
    values = yaml.safe_load("\n".join(lines))
    for name in Project.model_fields.keys() - Config.model_fields.keys():
        values.pop(name)
    assert Config.model_validate(values) == Config()


def batch(file: str) -> dict[str, Config]:
    raw = yaml.safe_load((Path(__file__).parents[2] / "config" / f"{file}.yaml").read_text())
    return {name: scene_config(raw, "fox", name) for name in raw["configs"]}


def test_the_original_is_the_same_in_all_batches():
    """At the resolution of the others, of any length; in ablations with the limit of Gaussians."""
    quality = batch("quality")
    found = {name: quality[name] for name in ("original_7k", "original_30k")}
    found["original"] = batch("ablations")["original"]
    assert len(set(map(Config.model_dump_json, quality.values()))) == len(quality)
    steps = {name: config.train.steps for name, config in found.items()}
    assert steps == {"original_7k": 7000, "original_30k": 30_000, "original": 4000}
    published = scene_config({"preset": "original"}, "fox")
    chosen = {
        "views": {"max_long_side_px"},
        "train": {"steps": True, "density": {"pixels_per_gaussian"}},
    }
    for config in found.values():
        assert config.views.max_long_side_px == Config().views.max_long_side_px
        assert config.model_dump(exclude=chosen) == published.model_dump(exclude=chosen)


@pytest.mark.parametrize(("file", "base"), [("ablations", "balanced"), ("skipping", "plan")])
def test_every_configuration_of_a_batch_differs_from_the_default(file, base):
    found = batch(file)
    assert found.pop(base) == Config()
    assert all(config != Config() for config in found.values())
    assert len(set(map(Config.model_dump_json, found.values()))) == len(found)


def test_the_option_page_speaks_of_values_not_of_types():
    page = docs.page()
    assert not any(word in page for word in ("typing.", "<class", "FieldInfo"))
    assert "| `budget_minutes` | number >= 0.001 <= 100000, `null` | minutes | `null` |" in page


def test_the_product_has_few_options():
    """Each with a description and, if it is a number, a range and a unit."""
    assert docs.num_options() <= 71
    for page in (docs.page(), docs.experiments_page()):
        rows = [line.split(" | ") for line in page.splitlines() if line.startswith("| `")]
        options = [row for row in rows if len(row) == 5]
        assert len(options) >= 30
        for name, values, unit, _, meaning in options:
            assert meaning.removesuffix(" |").strip().endswith("."), name
            assert not re.search(r"(^|, )(whole )?number(,|$)", values), f"{name} has no range"
            assert ("number" in values) <= bool(unit), f"{name} has no unit"
