"""``splatmake accept``: results are judged right, with reasons; wrong input is one clear error."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.export.counters import FileLoss
from pipeline.reporting.acceptance.command import Criteria, badge
from pipeline.reporting.acceptance.judge import Acceptance, judge
from pipeline.reporting.acceptance.measured import measured_of
from pipeline.reporting.acceptance.rules import Rules, read_rules
from pipeline.runtime.errors import EXIT_NOT_ACCEPTED, EXIT_USER_ERROR
from pipeline.sfm.counters import Gap
from tests.reporting.acceptance.results import PLACED, SPZ, accept, write_result
from tests.reporting.made import coverage, metrics

ALL = """
min_registered_share: 0.9
min_verdict: good
min_psnr: 26
min_ssim: 0.8
min_seen_share: 0.5
max_gaps: 0
max_contradicted_share: 0.1
max_floaters: 20
min_file_psnr: 45
max_gaussians: 200000
max_minutes: 5
max_memory_mb: 2000
max_warnings: 0
max_psnr_drop: 0.5
max_ssim_drop: 0.01
max_time_factor: 1.5
max_memory_factor: 1.2
baseline: baseline
"""
GAP = Gap(placed="a.jpg", other="c.jpg", component=None, matches=9)

FAULTS: dict[str, tuple[dict[str, Any], str]] = {
    "min_registered_share": ({"registered_images": 30}, "61.2 %, at least 90 % wanted"),
    "min_verdict": ({"sfm_verdict": "weak"}, "weak, good wanted"),
    "min_psnr": ({"psnr": 25.9999}, "PSNR 25.9999 dB, at least 26 dB wanted"),
    "min_ssim": ({"ssim": 0.5}, "SSIM 0.5000, at least 0.8 wanted"),
    "min_seen_share": ({"seen": 0.2}, "20.0 %, at least 50 % wanted"),
    "max_gaps": ({"gaps": [GAP]}, "gaps between parts of the scene 1, at most 0 wanted"),
    "max_contradicted_share": ({"contradicted": 0.2}, "20.0 %, at most 10 % wanted"),
    "min_file_psnr": (
        {"exported": [SPZ, FileLoss(file="point_cloud.sog", size_mb=0.6, psnr=39.0)]},
        "PSNR of the lossiest file 39.00 dB, at least 45 dB wanted",
    ),
    "max_gaussians": ({"num_gaussians": 200_001}, "200,001, at most 200,000 wanted"),
    "max_minutes": ({"minutes": 6.0}, "time 6.0 minutes, at most 5 minutes wanted"),
    "max_memory_mb": ({"memory_mb": 2500.0}, "2,500 MB, at most 2,000 MB wanted"),
    "max_warnings": ({"warnings": ["it is dark"]}, "warnings 1, at most 0 wanted"),
    "max_psnr_drop": ({"psnr": 27.0}, "PSNR below the baseline 1.00 dB, at most 0.5 dB wanted"),
    "max_ssim_drop": ({"ssim": 0.85}, "0.0500, at most 0.01 wanted"),
    "max_time_factor": ({"minutes": 4.0}, "2.00 times, at most 1.5 times wanted"),
    "max_memory_factor": ({"memory_mb": 1500.0}, "1.50 times, at most 1.2 times wanted"),
}


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    write_result(tmp_path / "baseline")
    return tmp_path / "barn"


def test_a_good_result_is_accepted(scene, capsys):
    assert accept(write_result(scene), ALL) == 0
    shown = capsys.readouterr().out
    assert shown.endswith("barn: accepted\n") and "not met" not in shown


@pytest.mark.parametrize("rule", FAULTS)
def test_each_fault_is_found_by_its_rule_and_said(scene, capsys, rule):
    changes, sentence = FAULTS[rule]
    write_result(scene, **changes)
    target = scene.parent / "judged.json"
    assert accept(scene, ALL, "--json", target) == EXIT_NOT_ACCEPTED
    shown = capsys.readouterr().out
    assert sentence in shown.splitlines()[-1]
    judged = Acceptance.model_validate_json(target.read_bytes())
    broken = {finding.rule for finding in judged.findings if not finding.met}
    # A result that takes longer than the limit takes longer than the baseline, too.
    relative = {"max_minutes": "max_time_factor", "max_memory_mb": "max_memory_factor"}
    also = {"min_psnr": "max_psnr_drop", "min_ssim": "max_ssim_drop"} | relative
    assert broken == {rule} | ({also[rule]} if rule in also else set())


def test_without_a_compressed_file_its_rule_is_not_met(scene, capsys):
    write_result(scene, exported=[])
    assert accept(scene, "min_file_psnr: 30\n") == EXIT_NOT_ACCEPTED
    assert "not measured (no compressed file was exported" in capsys.readouterr().out


def test_floaters_gaps_and_residuals_have_rules(scene, capsys):
    write_result(scene, georeference=PLACED)
    assert accept(scene, "max_floaters: 12\nmax_residual_m: 0.5\n") == EXIT_NOT_ACCEPTED
    shown = capsys.readouterr().out
    assert "floaters 13, at most 12 wanted" in shown
    assert "residual of the georeference 0.800 m, at most 0.5 m wanted" in shown


def test_without_rules_the_defaults_apply_and_are_shown(scene, capsys):
    assert accept(write_result(scene)) == 0
    shown = capsys.readouterr().out
    for name, value in Rules():
        assert (name in shown) == (value is not None)
    assert accept(write_result(scene, psnr=24.1)) == EXIT_NOT_ACCEPTED
    assert "PSNR 24.10 dB, at least 25 dB wanted" in capsys.readouterr().out


def test_the_example_file_has_the_default_rules():
    assert read_rules(Path(__file__).parents[3] / "config" / "acceptance.yaml") == Rules()


def test_a_judgement_is_the_baseline_of_the_next(scene, capsys):
    judged = scene.parent / "expected.json"
    assert accept(write_result(scene), "min_psnr: 20", "--json", judged) == 0
    write_result(scene, psnr=27.9, minutes=2.1)
    rules = "max_psnr_drop: 0.2\nmax_time_factor: 1.1\n"
    assert accept(scene, rules, "--baseline", judged) == 0
    assert accept(scene, rules + "baseline: expected.json\n") == 0
    metrics_json = scene / "report" / "metrics.json"
    assert accept(scene, "max_psnr_drop: 0", "--baseline", metrics_json) == 0
    capsys.readouterr()
    assert accept(scene, rules, "--baseline", metrics_json) == EXIT_USER_ERROR
    assert "max_time_factor: expected a baseline with times" in capsys.readouterr().err


def test_what_was_not_measured_does_not_meet_its_rule(scene, capsys):
    write_result(scene, registered_images=None, train_psnr=None)
    assert accept(scene, "min_registered_share: 0.5\nmin_psnr: 20") == EXIT_NOT_ACCEPTED
    shown = capsys.readouterr().out
    assert "not measured (no stage has counted them)" in shown
    assert "28.00 dB on training views" in shown


@pytest.mark.parametrize(
    ("rules", "message"),
    [
        ("min_psrn: 26", "min_psrn: there is no such rule (did you mean min_psnr?)"),
        ("min_psnr: sharp", "min_psnr: Input should be a valid number"),
        ("min_psnr: .nan", "min_psnr: Input should be a finite number"),
        ("min_psnr: true", "min_psnr: Input should be a number, not true or false"),
        ("max_warnings: -1", "max_warnings: Input should be greater than or equal to 0"),
        ("min_verdict: great", "min_verdict: Input should be 'good' or 'weak'"),
        ("", "expected at least one rule, found none"),
        ("[1, 2]", "expected a mapping of names to values (min_psnr: 26)"),
        ("min_psnr: [", "expected YAML"),
        ("max_psnr_drop: 1", "max_psnr_drop: expected a baseline to compare with, found none"),
        ("max_psnr_drop: 1\nbaseline: none.json", "none.json: no such file"),
        ("max_psnr_drop: 1\nbaseline: rules.yaml", "expected a baseline, an accepted.json"),
        ("max_residual_m: 1", "max_residual_m: expected a scene that is placed in metres"),
    ],
)
def test_wrong_rules_are_one_clear_error(scene, capsys, rules, message):
    assert accept(write_result(scene), rules) == EXIT_USER_ERROR
    shown = capsys.readouterr().err
    assert message in shown and shown.startswith("error: ") and "Traceback" not in shown
    assert "what to do: " in shown


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"scene": "house"}, "scene house instead of barn"),
        ({"resolution": ("80x60",)}, "resolution 80x60 instead of 640x480"),
        ({"split": "every 3rd"}, "split 'every 3rd' instead of 'every 8th'"),
        ({"per_view": ()}, "0 measured views instead of 2"),
        ({"scene": "barn@fast@seed2"}, None),
    ],
)
def test_a_baseline_that_is_not_comparable_is_refused(scene, capsys, changes, words):
    protocol = metrics().protocol.model_dump()
    known = {name: changes.pop(name) for name in [*changes] if name in protocol}
    write_result(scene.parent / "baseline", protocol=protocol | known, **changes)
    code = accept(write_result(scene), "max_psnr_drop: 1\nbaseline: baseline")
    shown = capsys.readouterr().err
    if words is None:
        assert code == 0
    else:
        assert code == EXIT_USER_ERROR and words in shown
        assert "the baseline cannot be compared with this result" in shown


def test_a_damaged_or_missing_result_is_one_clear_error(scene, capsys):
    assert accept(scene, "min_psnr: 26") == EXIT_USER_ERROR
    assert "no such file or folder" in capsys.readouterr().err
    write_result(scene)
    for text in ("", "{}", "[" * 100_000, '{"psnr": NaN}', "\0"):
        (scene / "report" / "metrics.json").write_text(text)
        assert accept(scene, "min_psnr: 26") == EXIT_USER_ERROR
        shown = capsys.readouterr().err
        assert "metrics.json: expected" in shown and "what to do" in shown
    (scene / "report" / "metrics.json").unlink()
    assert accept(scene, "min_psnr: 26") == EXIT_USER_ERROR
    assert accept(scene, "min_psnr: 26", "--baseline", scene / "report") == EXIT_USER_ERROR


@given(
    st.sampled_from(["min_psnr", "min_ssim", "min_registered_share"]),
    st.floats(0, 1),
    st.floats(0, 1),
)
def test_a_shown_figure_is_on_the_side_of_the_bound_on_which_it_is_judged(rule, wanted, value):
    """Also if both are nearly equal."""
    name = rule.removeprefix("min_")
    measured = measured_of(metrics(), coverage().record).model_copy(update={name: value})
    (found,) = judge(Rules.of(**{rule: wanted}), measured).findings
    assert found.met == (value >= wanted)
    bound, shown = (
        float(text.removeprefix("at least ").split()[0]) for text in (found.wanted, found.found)
    )
    if abs(value - wanted) > 1e-6:
        assert (shown >= bound) == found.met


def test_the_page_says_why_a_rule_does_not_suit_the_scene():
    criteria = Criteria(rules=Rules.of(max_residual_m=1.0))
    judgement = badge(criteria, measured_of(metrics(), coverage().record))
    assert judgement.startswith("not judged: max_residual_m: expected a scene")
    stored = Criteria.model_validate(json.loads(criteria.model_dump_json()))
    assert stored == criteria
