"""Hostile configurations: one message, of bounded length, before any job."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

import pytest

from pipeline.command import workflow
from pipeline.command.main import main
from pipeline.config.config_file import check_config_file
from pipeline.config.load import load_project
from pipeline.config.runs import MAX_NAME_BYTES, name_fault
from pipeline.runtime.errors import UserError

DEEP: list[Any] = ["x"]
for _ in range(40):
    DEEP = [DEEP] * 9

REFUSED: dict[str, tuple[dict[Any, Any], str]] = {
    "preset-of-a-scene": ({"scenes": {"a": {"preset": ["fast"]}}}, "scenes.a: preset: Input"),
    "preset-of-a-config": ({"configs": {"a": {"preset": ["fast"]}}}, "configs.a: preset: Input"),
    "preset": ({"preset": {"fast": 1}}, "preset: Input should be 'fast'"),
    "configs": ({"configs": [["fast"]]}, r"\['fast'\] is no preset"),
    "config-name": ({"configs": {"x" * 10_000: {}, "<": {}}}, "cannot name a configuration"),
    "steps-1e26": (
        {"train": {"steps": 10**26}},
        "train.steps: Input should be less than or equal to 10000000",
    ),
    "steps-digits": ({"train": {"steps": 10**5000}}, "found a number of thousands of digits"),
    "steps-true": ({"train": {"steps": True}}, "train.steps: .* not true or false, found True"),
    "weight-true": ({"experiments": {"train": {"mask_loss_weight": True}}}, "not true or false"),
    "weight-1e300": (
        {"experiments": {"train": {"mask_loss_weight": 1e300}}},
        "Input should be less than or equal to 1000000",
    ),
    "seed-true": ({"seed": True}, "seed: .* not true or false"),
    "seeds": ({"seeds": [True]}, "seeds.0: .* not true or false"),
    "bomb": ({"train": DEEP}, "train: Input should be a mapping"),
    "bomb-in-number": ({"train": {"steps": DEEP}}, "train.steps: Input should be a valid integer"),
    "long-value": ({"preset": "x" * 10_000_000}, "found 'xxx"),
    "long-name": ({"x" * 10_000_000: 1}, "xxx: no such option"),
    "key": ({3: 4}, "Keys should be strings, found 3"),
    "data_root-nul": ({"data_root": "a\0b"}, "data_root: .* without control characters"),
    "data_root-surrogate": ({"data_root": "\ud800"}, "data_root: Input should be a path in UTF-8"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_configuration_is_refused_with_its_option(case):
    raw, expected = REFUSED[case]
    with pytest.raises(UserError, match=expected) as caught:
        load_project(raw)
    assert len(str(caught.value)) < 1000


FILES: dict[str, tuple[bytes, str]] = {
    "utf-16": ("preset: fast\n".encode("utf-16"), "expected text in UTF-8, found other bytes at 0"),
    "latin-1": (b"preset: f\xe4st\n", "expected text in UTF-8, found other bytes at 9"),
    "unclosed": (b"preset: [fast\n", "line 2: expected YAML"),
    "list": (b"- preset\n", "expected a mapping"),
    "text": (b"fast\n", "expected a mapping"),
    "code": (b"preset: !!python/object/apply:os.system ['true']\n", "line 1: expected YAML"),
    "cycle": (b"scenes: &s {x: *s}\n", "an alias refers to a value that holds it"),
    "deep": (b"a: " + b"[" * 100_000, "expected YAML"),
    "digits": (b"seed: " + b"9" * 5000, "expected YAML: Exceeds the limit"),
    "large": (b"#" * (2 << 20), "expected at most 1 MiB"),
    "bomb": (
        b"a: &a [x,x,x,x,x,x,x,x,x]\n"
        + b"".join(
            b"%c: &%c [%s]\n" % (98 + i, 98 + i, b",".join([b"*%c" % (97 + i)] * 9))
            for i in range(12)
        ),
        "found .* values .by aliases.",
    ),
}


@pytest.mark.parametrize("case", FILES)
def test_a_configuration_file_is_refused_before_snakemake_reads_it(tmp_path, case):
    data, expected = FILES[case]
    file = tmp_path / "config.yaml"
    file.write_bytes(data)
    with pytest.raises(UserError, match=expected) as caught:
        check_config_file(file)
    assert caught.value.file == file and len(str(caught.value)) < 600


@pytest.mark.parametrize("command", ["run", "plan"])
@pytest.mark.parametrize("case", FILES)
def test_a_file_given_to_a_command_is_refused(tmp_path, monkeypatch, capfd, case, command):
    monkeypatch.setattr(workflow, "replace_process", lambda _: pytest.fail("Snakemake started"))
    data, expected = FILES[case]
    good, bad = tmp_path / "good.yaml", tmp_path / "bad.yaml"
    good.write_text("preset: fast\n")
    bad.write_bytes(data)
    for words in (["--configfile", str(good), str(bad), "-p"], [f"--configfiles={bad}"]):
        assert main([command, str(tmp_path), *words]) == 2
        said = capfd.readouterr().err
        assert re.search(f"bad.yaml: .*{expected}", said) and "what to do" in said
        assert len(said) < 600


@pytest.mark.parametrize("name", ["gone.yaml", ".", "/dev/zero"])
def test_a_configuration_file_that_is_none(tmp_path, name):
    with pytest.raises(UserError, match=r"cannot be read: No such file|expected a file"):
        check_config_file(tmp_path / name)


def test_the_output_of_a_command_is_left_to_snakemake(tmp_path):
    """It can be read once."""
    os.mkfifo(tmp_path / "pipe")
    check_config_file(tmp_path / "pipe")


@pytest.mark.parametrize("text", ["", "# nothing\n", "preset: fast\n", "\ufeffpreset: fast\n"])
def test_a_configuration_file_that_can_be_read(tmp_path, text):
    file = tmp_path / "config.yaml"
    file.write_text(text, encoding="utf-8")
    check_config_file(file)


def test_the_defaults_are_accepted():
    check_config_file(Path(__file__).parents[2] / "config" / "config.yaml")


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("<x>", "it has the character <"),
        ("{x}", "it has the character {"),
        ("ab" * 20, "it ends with ab twenty times"),
        ("x" + "a" * 20, "it ends with a twenty times"),
        ("é" * 101 + "x", f"it is longer than {MAX_NAME_BYTES} bytes"),
        ("a\nb", "control characters"),
        ("\udcff", "it is not UTF-8"),
    ],
)
def test_names_that_no_folder_of_results_can_have(name, expected):
    assert expected in str(name_fault(name))


@pytest.mark.parametrize("name", ["garden", "abab", "a b", "a'b", "s*", "$(x)", "é", "a@b", "-x"])
def test_names_that_a_scene_can_have(name):
    assert name_fault(name) is None
