"""Records of finished stages: a changed file or a damaged record is one clear error."""

import json
import random
import tempfile
from dataclasses import replace

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pipeline.io.recorded import digest_of, read_recorded
from pipeline.runtime.counters import NoCounters, StageCounters, read_counters
from pipeline.runtime.errors import UserError
from pipeline.runtime.job import Job, Request, run_stage
from pipeline.runtime.record import (
    RunRecord,
    StageRecord,
    check_outputs,
    file_digest,
    output_digests,
    read_record,
    read_run,
    read_stage,
)
from pipeline.scene.manifest import Manifest

KEY = {"stage": "work", "seed": 0, "config": {}}


@pytest.fixture(autouse=True)
def _temporary_files_stay_where_they_were(monkeypatch):
    monkeypatch.setenv("TMPDIR", tempfile.gettempdir())
    monkeypatch.setattr(tempfile, "tempdir", None)


class Shape(StageCounters):
    shape: tuple[int, float]
    colours: int | None = None


@pytest.fixture
def first(tmp_path):
    """A request whose stage has run, with two files."""
    asked = Request("first", KEY, {}, tmp_path / "my scene" / "first", 2, None, {})

    def work(job: Job) -> None:
        (job.out / "sparse").mkdir()
        (job.out / "sparse" / "images.bin").write_bytes(b"cameras")
        (job.out / "points.bin").write_bytes(b"points")
        job.counters = Shape(shape=(3, 0.1))

    assert run_stage(asked, work, Shape) == 0
    return asked


@pytest.fixture
def second(first):
    """A request of a stage that reads the first one's folder."""
    out = first.out.with_name("second")
    return replace(first, stage="second", inputs={"model": first.out, "again": first.out}, out=out)


def never(job: Job) -> None:
    raise AssertionError("worked on changed input")


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda out: (out / "sparse" / "images.bin").write_bytes(b"Cameras"), "has changed since"),
        (lambda out: (out / "points.bin").unlink(), "is missing; stage first wrote it"),
        (lambda out: (out / "more.bin").write_bytes(b""), "is not a file that stage first wrote"),
    ],
)
def test_a_changed_input_is_an_error_and_the_command_in_it_repairs_it(
    first, second, damage, said, capsys
):
    before = output_digests(first.out)
    damage(first.out)
    assert run_stage(second, never) == 2
    message = capsys.readouterr().err
    assert said in message and "Traceback" not in message
    assert f"'{first.out.parent}/metrics.json' --forcerun first" in message
    # What Snakemake does for --forcerun: it deletes the declared output and runs the job.
    (first.out / "stage.json").unlink()

    def again(job: Job) -> None:
        (job.out / "sparse").mkdir()
        (job.out / "sparse" / "images.bin").write_bytes(b"cameras")
        (job.out / "points.bin").write_bytes(b"points")
        job.counters = Shape(shape=(3, 0.1))

    assert run_stage(first, again, Shape) == 0
    assert output_digests(first.out) == before
    assert run_stage(second, lambda job: None) == 0


def test_a_stage_that_is_done_needs_no_inputs(first, second):
    assert run_stage(second, lambda job: None) == 0
    (first.out / "points.bin").unlink()
    assert run_stage(second, never) == 0


def test_hidden_files_of_others_are_no_inputs(first):
    (first.out / ".DS_Store").write_bytes(b"")
    check_outputs([first.out], threads=1)


def test_digests_do_not_depend_on_threads(first):
    one = output_digests(first.out, 1)
    assert one == output_digests(first.out, 3) == read_stage(first.out).outputs
    assert one["points.bin"] == file_digest(first.out / "points.bin")


@pytest.mark.parametrize(
    "content",
    ["", "{", "[]", "null", "{}", '{"stage": "first"}', '{"version": 2}', "\x00", "[" * 5000],
)
@pytest.mark.parametrize("name", ["stage.json", "run.json", "images.json"])
def test_a_damaged_record_is_one_clear_error(first, name, content):
    file = first.out / name
    file.write_text(content)
    read = {"stage.json": read_stage, "run.json": read_run}
    with pytest.raises(UserError, match=f"{name}: cannot be read.*\n.*--forcerun first"):
        read.get(name, lambda folder: Manifest.read(folder / name))(first.out)


def test_a_damaged_record_of_an_input_ends_the_stage_with_a_message(first, second, capsys):
    whole = (first.out / "stage.json").read_text()
    (first.out / "stage.json").write_text(whole[: len(whole) // 2])
    assert run_stage(second, never) == 2
    message = capsys.readouterr().err
    assert "stage.json: cannot be read" in message and "Traceback" not in message
    # --forcerun: the work is there, and its hidden record puts the declared one back.
    (first.out / "stage.json").unlink()
    assert run_stage(first, never, Shape) == 0
    assert (first.out / "stage.json").read_text() == whole


def test_counters_come_back_from_the_record(first):
    assert read_counters(first.out, Shape) == Shape(shape=(3, 0.1))
    recorded = json.loads((first.out / "stage.json").read_text())["counters"]
    assert recorded == {"shape": [3, 0.1]}, "a field that is not set is not recorded"
    assert Shape(shape=(3, 0.1), colours=None).recorded() == recorded | {"colours": None}


@pytest.mark.parametrize(
    ("counters", "said"),
    [
        ({}, "counters.shape: Field required"),
        ({"shape": [3]}, "counters.shape.1: Field required"),
        ({"shape": [3, "many"]}, "counters.shape.1: Input should be a valid number"),
        ({"shape": [3, 0.1], "size": 4}, "counters.size: Extra inputs"),
        ([], "counters: Input should be an object"),
    ],
)
def test_counters_that_do_not_fit_are_one_clear_error(first, counters, said):
    record = json.loads((first.out / "stage.json").read_text()) | {"counters": counters}
    (first.out / "stage.json").write_text(json.dumps(record))
    with pytest.raises(UserError) as caught:
        read_counters(first.out, Shape)
    message = str(caught.value)
    assert "first/stage.json: cannot be read" in message and said in message
    assert "--forcerun first" in message


@pytest.mark.parametrize("counters", [NoCounters(), Shape.model_construct()])
def test_a_stage_that_records_other_counters_than_it_declares_fails(first, counters, capfd):
    """A fault of the program: with a traceback, and without an output."""
    before = (first.out / "stage.json").read_text()

    def work(job: Job) -> None:
        job.counters = counters

    assert run_stage(replace(first, key=KEY | {"seed": 1}), work, Shape) == 1
    assert "Shape" in capfd.readouterr().err
    assert (first.out / "stage.json").read_text() == before


def test_another_stages_record_is_refused(first):
    record = json.loads((first.out / "stage.json").read_text()) | {"stage": "other"}
    (first.out / "stage.json").write_text(json.dumps(record))
    with pytest.raises(UserError, match=r"the record of stage first, found .* stage other"):
        read_stage(first.out)


def test_a_damaged_hidden_record_has_the_work_done_again(first):
    whole = (first.out / ".stage.json").read_text()
    for content in ("", "[]", "{}", '{"key": 3}', whole.replace('"shape"', '"form"')):
        (first.out / ".stage.json").write_text(content)
        worked = []

        def work(job: Job, worked: list = worked) -> None:
            worked.append(job.stage)
            job.counters = Shape(shape=(3, 0.1))

        assert run_stage(first, work, Shape) == 0
        assert worked == ["first"]


def test_a_file_of_a_stage_that_changed_names_the_stage(first):
    file = first.out / "points.bin"
    digest = digest_of(file)
    assert read_recorded(file, digest) == b"points"
    file.write_bytes(b"Points")
    with pytest.raises(UserError, match=r"has changed since stage first wrote it\n.*--forcerun"):
        read_recorded(file, digest)


_JSON = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=20,
)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(counters=st.dictionaries(st.text(), _JSON, max_size=4), seed=st.integers())
def test_a_garbled_record_is_read_or_refused_never_a_crash(tmp_path, counters, seed):
    """A record comes back as it was written; with bytes lost, changed or swapped it may be read or
    refused by a UserError."""
    record = StageRecord(
        stage="work",
        scene="s",
        key=KEY,
        inputs={},
        outputs={"a": "b"},
        counters=counters,
        decisions=("one",),
        warnings=(),
    )
    file = tmp_path / "stage.json"
    data = json.dumps(record.model_dump(mode="json")).encode()
    file.write_bytes(data)
    assert read_record(file, StageRecord) == record
    choose = random.Random(seed)
    garbled = bytearray(data[: choose.randrange(len(data) + 1)] or b"\xff")
    for _ in range(choose.randrange(4)):
        garbled[choose.randrange(len(garbled))] = choose.randrange(256)
    file.write_bytes(bytes(garbled))
    for model in (StageRecord, RunRecord, Manifest):
        try:
            read_record(file, model)
        except UserError as error:
            assert "stage.json: cannot be read" in str(error)


def test_the_remedy_for_one_of_several_jobs_names_their_rule(tmp_path):
    with pytest.raises(UserError, match=r"--forcerun match$"):
        read_stage(tmp_path / "match_12")
