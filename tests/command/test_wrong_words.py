"""Wrong words on the command line: one message that names what was meant, and exit code 2."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest

from pipeline.command import workflow
from pipeline.command.main import main, make_parser

REFUSED = {
    # options
    "run photos/door --stepz 100": "option --stepz (did you mean --config train.steps=100?)",
    "run --stepz 100 photos/door": "(did you mean --config train.steps=VALUE?)",
    "run photos/door --max-gausians=5": "--config train.density.max_gaussians=5?)",
    "run photos/door --presett fast": "unknown option --presett (did you mean --preset?)",
    "run photos/door --dryrunn": "unknown option --dryrunn (did you mean --dryrun?)",
    "run photos/door --frobnicate": "unknown option --frobnicate\n",
    "run photos/door --jobs three": "--jobs, -j",
    "run photos/door --cores nine": "expected a number of cores or all, found 'nine'",
    "run photos/door --preset fastt": "found 'fastt' (did you mean fast?)",
    "run photos/door --workflow-profile slrum": "no profile 'slrum' (did you mean slurm?)",
    "run photos/door --prese fast": "unknown option --prese (did you mean --preset?)",
    "doctor --jsn": "unknown option --jsn (did you mean --json?)",
    "convert a b --min-opacity 2": "expected a number from 0 to 1, found '2'",
    # commands and arguments
    "rnu photos/door": "no command 'rnu' (did you mean run?)",
    "photos/door": "run photos/door?)",
    "run photos/door garden": "unexpected argument 'garden'",
    "run photos/door results/door/plan.json -n": "unexpected argument 'results/door/plan.json'",
    "doctor now": "unexpected argument 'now'",
    "run": "missing FOLDER",
    "render a": "missing --cameras, -o/--out",
    # folders and files
    "run photos/dor": "expected a folder of photographs, found nothing (did you mean photos/door?)",
    "run phots/door": "(did you mean photos/door?)",
    "run bad.yaml": "expected a folder of photographs, found a file",
    "run 'photos/a {1}'": "it has the character {\n  what to do: name the scene with --name",
    "run photos/door --name a/b": "it is no name of a folder",
    "run photos/door --name taken": "the name 'taken' is taken by the photographs in",
    "batch photos/door": "expected a folder for each scene, found none",
    "batch photos --configs fast,balancd": "'balancd' is no preset (did you mean balanced?)",
    "batch photos --seeds 0,x": "expected whole numbers, as in 0,1,2, found 'x'",
    "view dor": "no such file or folder (did you mean results/door?)",
    "view photos/door": "expected a trained scene or a checkpoint of a training, found neither",
    "convert results/door/x.plyy y.spz": "(did you mean results/door/x.ply?)",
    "compare other.json": "no such file or folder\n  what to do: create one",
    # the configuration
    "run photos/door --config steps=100": "no such option (did you mean --config train.steps=100?)",
    "run photos/door --config trian.steps=100": "(did you mean --config train.steps=100?)",
    "run photos/door --config 'train={steps: 100'": "expected a value in YAML, found '{steps: 100'",
    "run photos/door --config train={steps: 100}": "expected NAME=VALUE, found '100}'",
    "run --config seed=3 photos/door": "found 'photos/door'\n  what to do: name FOLDER before",
    "run photos/door --config data_root=x": "FOLDER says where the photographs are",
    "run photos/door --configfile bda.yaml": "No such file or directory (did you mean bad.yaml?)",
    "run photos/door --configfile bad.yaml": "line 2: expected YAML",
    "options trian.stps": "there is no option trian.stps (did you mean train.steps?)",
}


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for folder in ("photos/door", "photos/garden", "photos/a {1}", "results/door", ".splatmake"):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / ".splatmake" / "taken").symlink_to(tmp_path / "photos" / "garden")
    (tmp_path / "results" / "door" / "x.ply").touch()
    (tmp_path / "bad.yaml").write_text("train: [\n")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("words", REFUSED)
def test_one_message_says_what_was_meant(
    place: Path,
    words: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(workflow, "replace_process", lambda _: pytest.fail("Snakemake starts"))
    assert main(shlex.split(words)) == 2
    printed = capsys.readouterr()
    assert printed.err.startswith("error: ") and REFUSED[words] in printed.err
    assert printed.err.count("\n") == 2 and not printed.out


def test_help_fits_on_a_screen_and_ends_with_an_example(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    parser = make_parser()
    commands = next(action.choices for action in parser._actions if action.metavar == "COMMAND")
    assert isinstance(commands, dict)
    for name, command in {"": parser, **commands}.items():
        lines = command.format_help().splitlines()
        assert len(lines) <= 32 and max(map(len, lines)) <= 80, name
        assert name == "" or lines[-1].startswith(f"  splatmake {name}"), name
