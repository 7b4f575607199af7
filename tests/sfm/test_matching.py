"""Matching: exact on any processor, cached pair by pair, the same file for any cache content."""

from __future__ import annotations

import ctypes
import json
import shutil
import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from pipeline.config import settled
from pipeline.plan.keys import stage_key
from pipeline.plan.plan import upstream
from pipeline.plan.scan import scan
from pipeline.runtime import processor, targets
from pipeline.runtime.isolate import run_isolated
from pipeline.runtime.native import compiler
from pipeline.runtime.targets import Variant
from pipeline.sfm import nearest as near
from pipeline.sfm.features import extract_features
from pipeline.sfm.second_look import SecondLook
from stages.workflow.registry import STAGES
from tests.plans import make_plan
from tests.sfm import corner, jobs
from tests.tools import need, unsupported

FEATURES = settled.Features(max_features=500)


def reference(a: np.ndarray, b: np.ndarray) -> near.Neighbours:
    """Reference implementation of one direction of ``nearest``."""
    far = 1 << 28
    whole = np.full((len(a), len(b) + 2), far, np.int64)
    whole[:, : len(b)] = ((a[:, None].astype(np.int64) - b[None]) ** 2).sum(-1)
    index = whole.argmin(1) if len(a) else np.zeros(0, int)
    ordered = np.sort(whole, axis=1)
    return near.Neighbours(np.where(index < len(b), index, -1), ordered[:, 0], ordered[:, 1])


def assert_equal(one: near.Neighbours, two: near.Neighbours) -> None:
    for name in ("index", "first", "second"):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))


def random_descriptors(seed: int, count: int, kind: str) -> np.ndarray:
    rng = np.random.default_rng(seed)
    values = {"bytes": 256, "extremes": 2, "ties": 2}[kind]
    table = rng.integers(0, values, (count, 128))
    if kind == "ties":  # a few distinct descriptors only
        table = table[rng.integers(0, min(3, count), count)] if count else table
    return (table * (255 if kind == "extremes" else 1)).astype(np.uint8)


@settings(max_examples=60, derandomize=True, deadline=None)
@given(
    counts=st.tuples(st.integers(0, 90), st.integers(0, 90)),
    kind=st.sampled_from(["bytes", "extremes", "ties"]),
    seed=st.integers(0, 99),
)
@example(counts=(1, 1), kind="extremes", seed=0)
@example(counts=(64, 64), kind="bytes", seed=0)
def test_the_two_nearest_equal_the_reference(counts, kind, seed):
    a, b = random_descriptors(seed, counts[0], kind), random_descriptors(seed + 1, counts[1], kind)
    of_a, of_b = near.nearest(a, b)
    assert_equal(of_a, reference(a, b))
    assert_equal(of_b, reference(b, a))


SOURCE = near.LIBRARY.sources / "nearest.cpp"


def cases() -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Descriptors that fill vectors partly, with the largest products and with ties."""
    for kinds in (("bytes", "extremes"), ("extremes", "extremes"), ("ties", "ties")):
        yield random_descriptors(1, 301, kinds[0]), random_descriptors(2, 277, kinds[1])


def check_library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, flags: list[str]) -> None:
    """Compile the matcher with these flags and compare it with the reference."""
    library = tmp_path / "matcher.so"
    command = [*compiler(), *flags, "-Werror", "-shared", str(SOURCE), "-o", str(library)]
    subprocess.run(command, check=True)
    monkeypatch.setattr(near, "_library", lambda: ctypes.CDLL(str(library)))
    for a, b in cases():
        of_a, of_b = near.nearest(a, b)
        assert_equal(of_a, reference(a, b))
        assert_equal(of_b, reference(b, a))


VARIANTS = [
    variant
    for target in targets.TARGETS
    for variant in targets.all_variants(target, near.LIBRARY.extensions)
]


@pytest.mark.parametrize("variant", VARIANTS, ids=lambda variant: variant.name)
def test_every_target_equals_the_reference(tmp_path, monkeypatch, variant):
    required = {extension.feature for extension in variant.extensions}
    if variant.target.missing or not required <= processor.features():
        unsupported(f"this processor cannot run {variant.name}")
    check_library(tmp_path, monkeypatch, near.LIBRARY.flags_for(variant))


def test_the_avx_vnni_code_equals_the_reference(tmp_path, monkeypatch):
    """AVX2 instructions emulate the one AVX-VNNI instruction, which few processors have."""
    target = targets.named("x86-64-v3")
    if target.missing:
        unsupported(f"this processor cannot run {target.name}")
    header = ["-include", str(Path(__file__).with_name("avx_vnni.h"))]
    check_library(tmp_path, monkeypatch, near.LIBRARY.flags_for(Variant(target)) + header)


ARM_COMPILER, ARM_EMULATOR = "aarch64-linux-gnu-g++", "qemu-aarch64"


@pytest.mark.parametrize(
    "variant",
    [variant for variant in VARIANTS if variant.target.name == "aarch64"],
    ids=lambda variant: variant.name,
)
def test_an_emulated_arm_processor_equals_the_reference(tmp_path, variant):
    need(ARM_COMPILER, ARM_EMULATOR)
    program, found = tmp_path / "driver", tmp_path / "found"
    files = [str(Path(__file__).with_name("nearest_driver.cpp")), str(SOURCE)]
    flags = [*near.LIBRARY.flags_for(variant), "-Werror", "-static"]
    subprocess.run([ARM_COMPILER, *flags, *files, "-o", str(program)], check=True)
    for a, b in cases():
        (tmp_path / "input").write_bytes(a.tobytes() + b.tobytes())
        command = [ARM_EMULATOR, program, str(len(a)), str(len(b)), tmp_path / "input", found]
        subprocess.run(command, check=True)
        values = np.fromfile(found, np.int32)
        assert_equal(near.Neighbours(*values[: 3 * len(a)].reshape(3, -1)), reference(a, b))
        assert_equal(near.Neighbours(*values[3 * len(a) :].reshape(3, -1)), reference(b, a))


def test_matches_are_mutual_and_pass_the_ratio_and_distance_tests():
    rng = np.random.default_rng(0)
    a = rng.integers(30, 60, (6, 128)).astype(np.uint8)
    b = a[[3, 0, 1, 2, 4]].copy()
    b[4] = np.clip(rng.integers(0, 90, 128), 0, 255)  # the fifth has no match
    b = np.vstack([b, b[1], np.zeros((1, 128), np.uint8)])  # the first has two equal matches
    found = near.match_descriptors(a, b, 0.8)
    assert found.dtype == np.uint32 and found.tolist() == [[1, 2], [2, 3], [3, 0]]
    assert near.match_descriptors(a[:0], b, 0.8).shape == (0, 2)


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """Folder, seven photographs of a room's corner, and their features."""
    folder = tmp_path_factory.mktemp("room")
    photos, _ = corner.write_scene(folder / "photos", 7, camera_group="a")
    manifest = corner.manifest(photos)
    extract_features(manifest, FEATURES, folder / "features", cache=folder / "cache", threads=2)
    return folder, photos


def test_adding_a_photograph_matches_its_pairs_only(room, tmp_path):
    folder, photos = room
    # The added one is in the middle of the order: image ids of the others change.
    fewer = corner.manifest([p for p in photos if p.name != photos[3].name])
    first = run_isolated(jobs.match, fewer, folder / "features", tmp_path / "matches", threads=1)
    whole = corner.manifest(photos)
    second = run_isolated(jobs.match, whole, folder / "features", tmp_path / "matches")
    assert (first["num_pairs"], first["num_cached"]) == (15, 0)
    assert (second["num_pairs"], second["num_cached"]) == (21, 15)
    run_isolated(jobs.match, whole, folder / "features", tmp_path / "afresh" / "matches")
    assert jobs.digests(tmp_path / "matches") == jobs.digests(tmp_path / "afresh" / "matches")


def test_copies_of_a_photograph_share_their_results(room, tmp_path):
    folder, photos = room
    for name in ("a copy.png", "view 99.png"):
        shutil.copy(photos[1].path, tmp_path / name)
    copies = [corner.photo(tmp_path / name) for name in ("a copy.png", "view 99.png")]
    manifest = corner.manifest([*photos[:2], *copies])
    extract_features(manifest, FEATURES, tmp_path / "f", cache=folder / "cache", threads=1)
    report = run_isolated(jobs.match, manifest, tmp_path / "f", tmp_path / "matches")
    assert report["num_pairs"] == report["num_verified"] == 6


def cached_pairs(cache: Path) -> int:
    (file,) = cache.glob("pairs-*.db")
    connection = sqlite3.connect(file)
    try:
        return connection.execute("SELECT count(*) FROM two_view_geometries").fetchone()[0]
    finally:
        connection.close()


def test_the_cache_distinguishes_settings_and_is_pruned(room, tmp_path):
    folder, photos = room
    for inliers, cached, stored in ((15, 0, 3), (16, 0, 6), (15, 3, 6), (17, 0, 3)):
        report = run_isolated(
            jobs.match,
            corner.manifest(photos[:3]),
            folder / "features",
            tmp_path / "matches",
            min_inliers=inliers,
        )
        found = report["num_cached"], cached_pairs(tmp_path / "cache")
        assert found == (cached, stored), inliers


def test_a_corrupt_cache_is_replaced(room, tmp_path):
    folder, photos = room
    manifest = corner.manifest(photos[:3])
    run_isolated(jobs.match, manifest, folder / "features", tmp_path / "matches")
    (file,) = (tmp_path / "cache").glob("pairs-*.db")
    file.write_bytes(b"not a database" * 1000)
    before = jobs.digests(tmp_path / "matches")
    report = run_isolated(jobs.match, manifest, folder / "features", tmp_path / "matches")
    assert report["num_cached"] == 0 and jobs.digests(tmp_path / "matches") == before


def test_weakly_connected_photographs_get_more_features(room, tmp_path):
    """Fifty features verify few pairs. The second look finds what as many features find at once,
    with the same bytes for any number of threads; it is not made where it is not needed."""
    folder, photos = room
    manifest = corner.manifest(photos)
    few = settled.Features(max_features=50)
    extract_features(manifest, few, tmp_path / "few", cache=tmp_path / "c", threads=2)
    look = SecondLook(few, tmp_path / "c", tmp_path / "more")
    before = run_isolated(jobs.match, manifest, tmp_path / "few", tmp_path / "a" / "matches")
    after = run_isolated(
        jobs.match, manifest, tmp_path / "few", tmp_path / "b" / "matches", threads=1, look=look
    )
    assert after["num_verified"] > before["num_verified"]
    assert "8192 features" in after["decisions"][1]
    direct = run_isolated(jobs.match, manifest, tmp_path / "more", tmp_path / "d" / "matches")
    assert direct["num_verified"] == after["num_verified"]
    written = [jobs.digests(tmp_path / name / "matches") for name in "bd"]
    assert written[0] == written[1]
    enough = run_isolated(
        *(jobs.match, manifest, folder / "features", tmp_path / "e" / "matches"),
        look=SecondLook(FEATURES, tmp_path / "c", tmp_path / "unused"),
    )
    assert "8192" not in str(enough["decisions"]) and not (tmp_path / "unused").exists()


def test_a_second_look_depends_on_strong_pairs():
    names = [f"{i}.jpg" for i in range(12)]
    ring = {(names[i - 1], names[i]): 30 for i in range(12)}
    across = {(names[i - 2], names[i]): 30 for i in range(12)}
    look = SecondLook(FEATURES, Path("cache"), Path("out"))
    assert look.is_needed(names, ring), "two pairs each"
    assert not look.is_needed(names, ring | across), "four pairs each"
    assert look.is_needed(names, ring | dict.fromkeys(across, 29)), "two of them strong"
    assert not look.is_needed(names[:2], {(names[0], names[1]): 30}), "there is one pair"
    most = look.features.model_copy(update={"max_features": 8192})
    assert not replace(look, features=most).is_needed(names, ring)


def run_stages(scene: Path, results: Path) -> dict[str, dict]:
    """run.json of the stages up to matches, run as Snakemake runs them."""
    config = settled.Config(features=FEATURES)
    found = scan(scene, "corner", config, cache=None)
    plan = make_plan(found, config, str(scene))
    for stage in ("inspect", "features", "matches"):
        inputs = upstream(STAGES[stage], plan)
        command = [sys.executable, "-m", "stages", stage, "--out", str(results / stage)]
        command += ["--key", stage_key(STAGES[stage], plan)]
        command += ["--threads", "2"]
        command += ["--input", *(f"{role}={results / name}" for role, name in inputs.items())]
        subprocess.run(command, check=True, capture_output=True, cwd=Path(__file__).parents[2])
    stages = ("features", "matches")
    return {name: json.loads((results / name / "run.json").read_text()) for name in stages}


def test_the_stages_record_that_one_photograph_was_added(room, tmp_path):
    _, photos = room
    scene, results = tmp_path / "scene", tmp_path / "results" / "corner"
    (scene / "images").mkdir(parents=True)
    for photo in photos[:5]:
        shutil.copy(photo.path, scene / "images")
    first = run_stages(scene, results)
    assert first["features"]["num_cached"] == first["matches"]["num_cached"] == 0
    shutil.copy(photos[5].path, scene / "images")
    second = run_stages(scene, results)
    # Six photographs and 15 pairs: one photograph is extracted and its five pairs are matched.
    assert second["features"]["num_cached"] == 5
    assert second["matches"]["num_cached"] == 10
