"""The frame around every stage: atomic outputs, identity, locks, messages."""

import json
import multiprocessing
import tempfile
import time
from dataclasses import replace

import pytest

from pipeline.runtime.errors import UserError
from pipeline.runtime.job import Job, Request, run_stage
from pipeline.runtime.record import content_digest

KEY = {"stage": "work", "seed": 0, "config": {}}


@pytest.fixture(autouse=True)
def _temporary_files_stay_where_they_were(monkeypatch):
    """A stage has a process to itself, and a temporary folder; tests after these have not."""
    monkeypatch.setenv("TMPDIR", tempfile.gettempdir())
    monkeypatch.setattr(tempfile, "tempdir", None)


def request(tmp_path, key=KEY, **kwargs):
    defaults = {"inputs": {}, "threads": 1, "log": tmp_path / "work.log", "publish": {}}
    return Request(stage="work", key=key, out=tmp_path / "scene" / "work", **defaults | kwargs)


def write(text):
    def work(job: Job) -> None:
        (job.out / "result.txt").write_text(text)

    return work


def fail(job: Job) -> None:
    raise AssertionError("worked although everything was there")


def test_a_wrong_target_ends_a_stage_before_its_work(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("SPLATMAKE_TARGET", "x86-64-v9")
    assert run_stage(request(tmp_path), fail) == 2
    assert "unknown instruction-set target 'x86-64-v9'" in capsys.readouterr().err
    assert not (tmp_path / "scene" / "work").exists()


def test_outputs_and_sidecars_appear_together(tmp_path):
    assert run_stage(request(tmp_path), write("a")) == 0
    out = tmp_path / "scene" / "work"
    record = json.loads((out / "stage.json").read_text())
    assert list(record["outputs"]) == ["result.txt"]
    assert {
        "wall_s",
        "cpu_s",
        "peak_rss_mb",
        "versions",
        "instruction_set",
        "compiler",
    } <= json.loads((out / "run.json").read_text()).keys()
    assert record["counters"] == {}


def test_same_work_gives_the_same_record(tmp_path):
    for name in ("one", "two"):
        assert run_stage(request(tmp_path / name), write("a")) == 0
    one, two = ((tmp_path / n / "scene/work/stage.json").read_bytes() for n in ("one", "two"))
    assert one == two


def test_finished_work_is_not_repeated_when_snakemake_deleted_the_record(tmp_path):
    run_stage(request(tmp_path), write("a"))
    record = tmp_path / "scene" / "work" / "stage.json"
    before = record.read_bytes()
    record.unlink()
    assert run_stage(request(tmp_path), fail) == 0
    assert record.read_bytes() == before


@pytest.mark.parametrize("damage", ["changed", "missing", "added"])
def test_damaged_outputs_are_made_again(tmp_path, damage):
    run_stage(request(tmp_path), write("a"))
    out = tmp_path / "scene" / "work"
    if damage == "changed":
        (out / "result.txt").write_text("b")
    elif damage == "missing":
        (out / "result.txt").unlink()
    else:
        (out / "added.txt").write_text("x")
    assert run_stage(request(tmp_path), write("a")) == 0
    assert (out / "result.txt").read_text() == "a"
    assert not (out / "added.txt").exists()


def test_a_neighbours_same_work_is_taken_over(tmp_path):
    run_stage(request(tmp_path), write("a"))
    other = replace(request(tmp_path), out=tmp_path / "scene@fast" / "work")
    assert run_stage(other, fail) == 0
    mine, its = tmp_path / "scene@fast" / "work", tmp_path / "scene" / "work"
    assert (mine / "result.txt").samefile(its / "result.txt")
    record = json.loads((mine / "stage.json").read_text())
    assert record == json.loads((its / "stage.json").read_text()) | {"scene": "scene@fast"}
    assert json.loads((mine / "run.json").read_text())["taken_from"] == "scene"
    # The neighbour made anew does not change what was taken.
    run_stage(request(tmp_path, key=KEY | {"seed": 1}), write("b"))
    assert (mine / "result.txt").read_text() == "a"


@pytest.mark.parametrize("difference", ["key", "damage"])
def test_a_neighbours_other_or_damaged_work_is_not_taken(tmp_path, difference):
    run_stage(request(tmp_path), write("a"))
    if difference == "damage":
        (tmp_path / "scene" / "work" / "result.txt").write_text("damaged")
    key = KEY | {"seed": 1} if difference == "key" else KEY
    other = replace(request(tmp_path, key=key), out=tmp_path / "scene@fast" / "work")
    assert run_stage(other, write("mine")) == 0
    assert (tmp_path / "scene@fast/work/result.txt").read_text() == "mine"


def test_a_changed_key_works_again(tmp_path):
    run_stage(request(tmp_path), write("a"))
    assert run_stage(request(tmp_path, key=KEY | {"seed": 1}), write("b")) == 0
    assert (tmp_path / "scene/work/result.txt").read_text() == "b"


def test_an_input_made_again_with_the_same_content_changes_nothing(tmp_path):
    upstream = request(tmp_path)
    run_stage(upstream, write("a"))
    first = content_digest(upstream.out)
    run_stage(request(tmp_path, key=KEY | {"source": "other code"}), write("a"))
    assert content_digest(upstream.out) == first


def test_a_failed_stage_leaves_the_former_output_whole_and_says_why(tmp_path, capsys):
    def bad(job: Job) -> None:
        (job.out / "result.txt").write_text("half")
        raise UserError("is empty", file="photo.jpg", fix="take a photograph")

    run_stage(request(tmp_path), write("a"))
    assert run_stage(request(tmp_path, key=KEY | {"seed": 1}), bad) == 2
    message = capsys.readouterr().err
    assert "photo.jpg: is empty" in message
    assert "take a photograph" in message
    assert "Traceback" not in message
    assert (tmp_path / "work.log").read_text() in message
    assert (tmp_path / "scene/work/result.txt").read_text() == "a"
    assert not list((tmp_path / "scene/.scratch").rglob("result.txt"))


def test_a_full_disk_is_one_clear_message(tmp_path, capsys):
    def full(job: Job) -> None:
        raise OSError(28, "No space left on device", "results/x/image.png")

    assert run_stage(request(tmp_path), full) == 2
    message = capsys.readouterr().err
    assert "the disk is full" in message
    assert "Traceback" not in message


def test_a_kill_between_the_two_renames_loses_nothing(tmp_path):
    run_stage(request(tmp_path), write("a"))
    out = tmp_path / "scene" / "work"
    out.rename(out.with_name(".work.old"))
    assert run_stage(request(tmp_path), fail) == 0
    assert (out / "result.txt").read_text() == "a"


def test_scratch_survives_a_failure_and_goes_with_success(tmp_path):
    seen = []

    def resumable(job: Job) -> None:
        checkpoint = job.scratch / "checkpoint"
        seen.append(checkpoint.exists())
        if not checkpoint.exists():
            checkpoint.write_text("half way")
            raise UserError("stopped")
        (job.out / "result.txt").write_text("done")

    assert run_stage(request(tmp_path), resumable) == 2
    assert run_stage(request(tmp_path), resumable) == 0
    assert seen == [False, True]
    assert not (tmp_path / "scene/.scratch/work").exists()


def _slow(job: Job) -> None:
    trace = job.out.parents[2] / "trace"
    with open(trace, "a") as file:
        file.write("in ")
        file.flush()
        time.sleep(0.5)
        file.write("out ")
    (job.out / "result.txt").write_text("a")


def _run_slow(tmp_path):
    run_stage(request(tmp_path), _slow)


def test_two_runs_at_once_work_once(tmp_path):
    context = multiprocessing.get_context("fork")
    both = [context.Process(target=_run_slow, args=(tmp_path,)) for _ in range(2)]
    for process in both:
        process.start()
    for process in both:
        process.join()
    assert (tmp_path / "scene" / ".scratch" / "trace").read_text() == "in out "
    assert (tmp_path / "scene/work/result.txt").read_text() == "a"


def test_published_outputs_come_back_with_the_record(tmp_path):
    target = tmp_path / "scene" / "result.txt"
    asked = request(tmp_path, publish={"result.txt": target})
    run_stage(asked, write("a"))
    target.unlink()
    assert run_stage(asked, fail) == 0
    assert target.read_text() == "a"
