"""``python -m benchmarks.pose_conventions``: mistakes in pose files, and right poses.

Every mistake of ``files`` is written for the photographs of some scenes with known poses, and the
plan and the comparison with the photographs' matches are run on it. Right poses of these and other
scenes are run, too: none may be refused.
"""

from __future__ import annotations

import argparse
import re
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks.measured import add_record_options, measured, write_record
from benchmarks.pose_conventions.files import PROGRAMS, Mistake, Program, poses_of
from benchmarks.record_tables import poses_table
from benchmarks.results import PoseOutcome, PoseResult
from pipeline.config.schema import Config
from pipeline.io.colmap import read_model
from pipeline.plan.given_poses import load_given
from pipeline.plan.scan import scan
from pipeline.runtime.errors import UserError
from pipeline.sfm.pose_check.check import check_poses
from pipeline.sfm.pose_check.matches import FeatureMatcher

SCENES = ("fox", "lund_door")
_TRUTH = "sparse_gt"
_AGREE = "agree with"


def check(folder: Path, matcher: FeatureMatcher) -> tuple[PoseOutcome, str]:
    """The outcome for a scene folder, and what is said about its poses."""
    try:
        found = scan(folder, folder.name, Config(), cache=None)
        poses = found.poses
        if poses is None:
            return "silent", "no given poses were found"
        path = folder / poses.path
        photos = found.manifest.photos
        given = load_given(path, poses.kind, photos, found.listed, found.base_folder)
        model = given.normalization.model_to_given(given.model)
        said = check_poses(model, photos, poses.kind, path, matcher)
    except UserError as error:
        return "refused", str(error)
    if said.warnings:
        return "warned", " ".join(said.warnings)
    text = " ".join(said.decisions)
    return ("agree" if _AGREE in text else "silent"), text


def mistakes(scene: Path, matcher: FeatureMatcher) -> Iterator[PoseResult]:
    """The outcomes of all mistakes, and of the right poses, in the files of all programs."""
    poses = poses_of(read_model(scene / _TRUTH))
    for program in PROGRAMS:
        for mistake in ("", *program.named):
            with TemporaryDirectory() as name:
                folder = Path(name) / scene.name
                (folder / "images").mkdir(parents=True)
                for pose in poses:
                    file = folder / "images" / pose.name
                    file.parent.mkdir(parents=True, exist_ok=True)
                    file.symlink_to(scene / "images" / pose.name)
                program.write(folder, poses, mistake)
                yield result(folder, scene.name, program, mistake, matcher)


def result(
    folder: Path, scene: str, program: Program | None, mistake: Mistake, matcher: FeatureMatcher
) -> PoseResult:
    start = time.monotonic()
    outcome, text = check(folder, matcher)
    if mistake and program is not None:
        if outcome == "refused" and re.search(program.named[mistake], text):
            outcome = "named"
        elif outcome == "agree":
            outcome = "silent"
    return PoseResult(
        scene=scene,
        program="" if program is None else program.name,
        mistake=mistake,
        outcome=outcome,
        text=text.replace(f"{folder}/", ""),
        seconds=round(time.monotonic() - start, 2),
    )


def right(scene: Path) -> PoseResult:
    """The outcome of a scene's own poses, given or true."""
    with TemporaryDirectory() as name:
        folder = Path(name) / scene.name
        folder.mkdir()
        for entry in scene.iterdir():
            if entry.name != _TRUTH:
                (folder / entry.name).symlink_to(entry)
        if (scene / _TRUTH).is_dir():
            (folder / "sparse").mkdir()
            (folder / "sparse" / "0").symlink_to(scene / _TRUTH)
        return result(folder, scene.name, None, "", FeatureMatcher())


def main() -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.pose_conventions",
        description="Mistakes in pose files, and right poses.",
    )
    parser.add_argument("--data", type=Path, default=Path("../shared/data"), metavar="FOLDER")
    parser.add_argument("--scenes", nargs="*", default=SCENES, help="scenes with sparse_gt/")
    parser.add_argument("--right", nargs="*", default=[], help="scenes whose own poses are checked")
    add_record_options(parser)
    options = parser.parse_args()
    results: list[PoseResult] = []

    def add(found: PoseResult) -> None:
        results.append(found)
        print(
            f"{found.scene:16} {found.program:18} {found.mistake or 'right':10} {found.outcome:8} "
            f"{found.seconds:5.1f} s  {found.text[:300]}",
            file=sys.stderr,
            flush=True,
        )

    for scene in options.scenes:
        matcher = FeatureMatcher()
        for found in mistakes((options.data / scene).resolve(), matcher):
            add(found)
    for scene in options.right:
        add(right((options.data / scene).resolve()))
    print(poses_table(results))
    if options.json is not None:
        write_record(options.json, measured("pose_conventions", options.note), results)
    return 0


if __name__ == "__main__":
    sys.exit(main())
