"""Names of runs: each names one run, whatever the scene's folder is called."""

from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.config.runs import Run, all_runs, is_config_name, parse_run

CONFIGS = ("fast", "sh-0", "v1.5")
scenes = st.text("ab@1._ seedfast-", min_size=1, max_size=12)


@settings(max_examples=300, derandomize=True, deadline=None)
@given(scenes, st.sampled_from(["", *CONFIGS]), st.none() | st.integers(0, 2**31))
def test_a_name_gives_its_run_back(scene, config, seed):
    run = Run(scene, config, seed)
    assert parse_run(run.name, CONFIGS, {scene}) == run


def test_names_read_well():
    runs = all_runs(["fox"], ["fast", "high"], [0, 1])
    assert [run.name for run in runs] == [
        "fox@fast@seed0",
        "fox@fast@seed1",
        "fox@high@seed0",
        "fox@high@seed1",
    ]
    assert [run.name for run in all_runs(["fox"], [], [])] == ["fox"]
    assert [run.name for run in all_runs(["fox"], [], [3])] == ["fox@seed3"]


def test_a_scene_called_like_a_run_is_that_scene():
    assert parse_run("fox@fast", CONFIGS, {"fox", "fox@fast"}) == Run("fox@fast")
    assert parse_run("fox@slow", CONFIGS, {"fox"}) == Run("fox@slow")


def test_a_configuration_is_never_taken_for_a_seed_or_a_path():
    assert all(is_config_name(name) for name in CONFIGS)
    assert not any(is_config_name(name) for name in ("seed0", "a@b", "a/b", "", ".hidden", "a b"))
