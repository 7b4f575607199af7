"""The records of a finished stage, and checks of its files against them.

A stage's folder has two records besides its outputs:

- ``stage.json`` (``StageRecord``): reproducible. Key, digests of inputs and outputs, counters,
  decisions, warnings. ``.stage.json`` is a copy, because Snakemake deletes a job's declared outputs
  before it runs the job.
- ``run.json`` (``RunRecord``): differs between runs. Versions, commit, machine, instruction set,
  wall and CPU time, peak memory.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from pipeline.runtime.errors import UserError
from pipeline.runtime.layout import rerun_command

STAGE, HIDDEN_STAGE, RUN = "stage.json", ".stage.json", "run.json"
RECORDS = (STAGE, HIDDEN_STAGE, RUN)

M = TypeVar("M", bound=BaseModel)


class StageRecord(BaseModel):
    """``stage.json``: a stage's key, inputs and results."""

    model_config = ConfigDict(extra="forbid", frozen=True, ser_json_inf_nan="constants")

    version: Literal[1] = Field(1, description="Version of this record's format.")
    stage: str = Field(description="The stage's name.")
    scene: str = Field(description="The run's name: a scene, alone or with configuration and seed.")
    key: dict[str, Any] = Field(description="What decides the result beside the inputs.")
    inputs: dict[str, str] = Field(
        description="Role of an input to the digest of what its stage made (SHA-256)."
    )
    outputs: dict[str, str] = Field(
        description="Path of a file, relative to the stage's folder, to the SHA-256 of its bytes."
    )
    counters: dict[str, Any] = Field(
        description="Counts and measures of the result; `counters.schema.json` has those of each "
        "stage."
    )
    decisions: tuple[str, ...] = Field(description="What the stage decided and why.")
    warnings: tuple[str, ...] = Field(description="What the user should know.")

    @property
    def identity(self) -> str:
        """Digest of key and inputs; equal for the same work."""
        return identity(self.key, self.inputs)

    @property
    def content(self) -> str:
        """Digest of the results: outputs, counters and warnings.

        Ground truth (``truth/``) is excluded. No results depend on it except evaluations, whose
        keys contain its digest.
        """
        content = {
            "outputs": {k: v for k, v in self.outputs.items() if not k.startswith("truth/")},
            "counters": self.counters,
            "warnings": self.warnings,
        }
        return _sha256(canonical(content))


class RunRecord(BaseModel):
    """``run.json``: facts about a stage's run, which differ between runs of the same work.

    Further fields are facts about the machine, and timings specific to the stage.
    """

    model_config = ConfigDict(extra="allow", frozen=True, ser_json_inf_nan="constants")

    wall_s: float = Field(ge=0, description="Seconds from start to end.")
    cpu_s: float = Field(ge=0, description="CPU seconds of the process and its children.")
    peak_rss_mb: float = Field(ge=0, description="Peak memory, MiB.")
    earlier_s: float = Field(0.0, ge=0, description="Seconds of runs that were killed before.")
    curve_seconds: list[float] | None = Field(
        None, description="Seconds at each record of the training curve; train alone has them."
    )
    threads: int = Field(ge=1, description="Native threads.")
    seed: int | None = Field(description="The seed; null for a stage that draws no numbers.")
    versions: dict[str, str] = Field(description="Package to its version.")
    commit: str | None = Field(description="The program's git commit, where it is known.")
    finished: str = Field(description="Local time, ISO 8601.")


# --- digests ----------------------------------------------------------------------------------


def canonical(value: Any) -> str:
    """Canonical JSON: sorted keys, no spaces, no NaN."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)


def identity(key: Mapping[str, Any], inputs: Mapping[str, str]) -> str:
    """Digest of a key and of the inputs' content."""
    return _sha256(canonical({"key": key, "inputs": inputs}))


def file_digest(path: Path) -> str:
    """SHA-256 of a file's bytes, hexadecimal."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def output_digests(folder: Path, threads: int = 1) -> dict[str, str]:
    """Path -> digest of every file in a stage's folder except its records."""
    files = sorted(p for p in folder.rglob("*") if p.is_file() and p.name not in RECORDS)
    with ThreadPoolExecutor(max(threads, 1)) as pool:
        digests = list(pool.map(file_digest, files))
    names = [file.relative_to(folder).as_posix() for file in files]
    return dict(zip(names, digests, strict=True))


def _sha256(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


# --- reading ----------------------------------------------------------------------------------


def read_stage(folder: Path) -> StageRecord:
    """The record of a finished stage.

    Raises:
        UserError: The record is missing, damaged, or belongs to another stage.
    """
    record = read_record(folder / STAGE, StageRecord)
    if record.stage != folder.name:
        raise UserError(
            f"expected the record of stage {folder.name}, found that of stage {record.stage}",
            file=folder / STAGE,
            fix=rerun(folder),
        )
    return record


def read_run(folder: Path) -> RunRecord:
    """The record of a finished stage's run.

    Raises:
        UserError: The stage's record is missing or damaged.
    """
    return read_record(folder / RUN, RunRecord)


def read_record(path: Path, model: type[M], fix: str | None = None) -> M:
    """A JSON file that a stage wrote, as ``model``.

    Args:
        fix: The remedy for a damaged file. None means to rerun the stage whose folder it is in.

    Raises:
        UserError: The record is missing, truncated, or not valid for ``model``.
    """
    fix = fix or rerun(path.parent)
    try:
        return model.model_validate_json(path.read_bytes())
    except FileNotFoundError:
        raise UserError("this stage's output is missing", file=path, fix=fix) from None
    except ValidationError as error:
        raise unreadable(path, error, fix) from None


def unreadable(
    path: Path, error: ValidationError, fix: str, inside: tuple[str, ...] = ()
) -> UserError:
    """The error for a record that does not fit its model.

    Args:
        inside: The field of the record that was validated, or empty for the whole record.
    """
    first = error.errors()[0]
    where = ".".join(map(str, (*inside, *first["loc"])))
    found = f"{where}: {first['msg']}" if where else first["msg"]
    return UserError(
        f"cannot be read: it is damaged or from another version of the program ({found})",
        file=path,
        fix=fix,
    )


def content_digest(folder: Path) -> str:
    """Digest of a finished stage's results (see ``StageRecord.content``)."""
    return read_stage(folder).content


def is_current(folder: Path, key: str, inputs: Mapping[str, Path]) -> bool:
    """Whether the stage with this folder has finished with this key and the present content of its
    inputs (role -> folder)."""
    try:
        record = read_stage(folder)
        digests = {role: content_digest(path) for role, path in inputs.items()}
    except (UserError, OSError):
        return False
    return canonical(record.key) == key and record.inputs == digests


def missing_output(folder: Path) -> Path | None:
    """A file that is missing from the folder of a finished stage; the folder itself if it does not
    exist. None if all files exist, or if the record cannot be read."""
    if not folder.is_dir():
        return folder
    if not (folder / STAGE).is_file():
        return folder / STAGE
    try:
        names = read_stage(folder).outputs
    except UserError:
        return None
    return next((folder / name for name in names if not (folder / name).exists()), None)


# --- checking ---------------------------------------------------------------------------------


def check_outputs(folders: Iterable[Path], threads: int) -> None:
    """Compare the files of finished stages with the digests in their records.

    Hidden files without a record, as written by file managers and file servers, are ignored.

    Raises:
        UserError: a file has changed, is missing, or was not written by the stage.
    """
    for folder in sorted(set(folders)):
        recorded = read_stage(folder).outputs
        found = output_digests(folder, threads)
        for name in sorted(recorded.keys() | found.keys()):
            unknown = name not in recorded
            if recorded.get(name) == found.get(name) or (unknown and _is_hidden(name)):
                continue
            if unknown:
                what = f"is not a file that stage {folder.name} wrote"
            elif name not in found:
                what = f"is missing; stage {folder.name} wrote it"
            else:
                what = changed(folder)
            raise UserError(what, file=folder / name, fix=rerun(folder))


def _is_hidden(name: str) -> bool:
    return name.rpartition("/")[2].startswith(".")


def owner_of(path: Path) -> Path | None:
    """The folder of the finished stage that a file belongs to, or None."""
    return next((folder for folder in path.parents if (folder / HIDDEN_STAGE).is_file()), None)


def changed(folder: Path) -> str:
    """The error message for a file of the stage with this folder that has changed."""
    return f"has changed since stage {folder.name} wrote it"


def rerun(folder: Path) -> str:
    """The advice to rerun the stage with this folder, which may be that of one of its jobs."""
    stage = re.sub(r"_[0-9]+$", "", folder.name)
    return (
        f"add --forcerun {stage} to the end of the command that you use, as in: "
        f"{rerun_command(folder.parent)} --forcerun {stage}"
    )
