"""Features and matches computed by several jobs: the same files as by one."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.config import settled
from pipeline.runtime.isolate import run_isolated
from pipeline.sfm.chunks import chunk
from pipeline.sfm.features import extract_features, extract_photos, gather_features
from pipeline.sfm.pair_list import PairList
from tests.sfm import corner, jobs

FEATURES = settled.Features(max_features=500)


@given(count=st.integers(0, 100), number_of_jobs=st.integers(1, 12))
def test_chunks_are_consecutive_and_of_nearly_the_same_length(count, number_of_jobs):
    items = list(range(count))
    chunks = [chunk(items, i + 1, number_of_jobs) for i in range(number_of_jobs)]
    assert [item for part in chunks for item in part] == items
    lengths = [len(part) for part in chunks]
    assert max(lengths) - min(lengths) <= 1


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """Folder and photographs of a room's corner, and their features and matches by one job."""
    folder = tmp_path_factory.mktemp("room")
    photos, _ = corner.write_scene(folder / "photos", 7, camera_group="a")
    manifest = corner.manifest(photos)
    report = extract_features(
        manifest, FEATURES, folder / "features", cache=folder / "features-cache", threads=2
    )
    matched = run_isolated(jobs.match, manifest, folder / "features", folder / "matches")
    return folder, photos, report, matched


def extract_in_jobs(manifest, folder: Path, count: int, config=FEATURES):
    """The report of the gathered features, and the number of photographs found in the cache."""
    out = folder / "features"
    shutil.rmtree(out, ignore_errors=True)  # Stages start with an empty folder.
    parts, cached = {}, 0
    cache = folder / "features-cache"
    for number in range(1, count + 1):
        part, some = folder / f"extract_{number}", chunk(manifest.photos, number, count)
        report = extract_photos(some, config, part, cache=cache, threads=1)
        parts[part] = report.counters
        cached += report.num_cached
    return gather_features(manifest, config, parts, out, cache=cache), cached


@pytest.mark.parametrize("count", [2, 3, 9])
def test_files_and_reports_do_not_depend_on_the_number_of_jobs(room, tmp_path, count):
    """Nine jobs for seven photographs: as many are planned where some turn out to be copies."""
    folder, photos, features, matched = room
    manifest = corner.manifest(photos)
    gathered, _ = extract_in_jobs(manifest, tmp_path, count)
    assert jobs.flat(gathered) == jobs.flat(features) | {"num_cached": 0}
    assert jobs.digests(tmp_path / "features") == jobs.digests(folder / "features")
    report = run_isolated(
        jobs.match_in_jobs, manifest, tmp_path / "features", tmp_path / "matches", count
    )
    assert report == matched
    assert jobs.digests(tmp_path / "matches") == jobs.digests(folder / "matches")


def test_photographs_and_pairs_stay_in_the_cache_when_chunks_move(room, tmp_path):
    """One photograph is added, and more jobs share the work."""
    _, photos, _, _ = room
    fewer = corner.manifest([p for p in photos if p.name != photos[0].name])
    extract_in_jobs(fewer, tmp_path, 2)
    run_isolated(jobs.match_in_jobs, fewer, tmp_path / "features", tmp_path / "matches", 2)
    whole = corner.manifest(photos)
    _, cached = extract_in_jobs(whole, tmp_path, 3)
    assert cached == 6
    second = run_isolated(jobs.match_in_jobs, whole, tmp_path / "features", tmp_path / "matches", 3)
    assert (second["num_pairs"], second["num_cached"]) == (21, 15)


def test_the_division_is_not_in_the_cache_key_of_features(room, tmp_path):
    _, photos, _, _ = room
    manifest = corner.manifest(photos[:2])
    extract_in_jobs(manifest, tmp_path, 1)
    other = FEATURES.model_copy(update={"photos_per_job": 1})
    assert extract_in_jobs(manifest, tmp_path, 2, other)[1] == 2


def test_a_killed_job_goes_on_and_a_corrupt_cache_is_left_out(room, tmp_path):
    folder, photos, _, matched = room
    manifest = corner.manifest(photos)
    args = (manifest, folder / "features", tmp_path / "matches")
    (tmp_path / "cache").mkdir()
    run_isolated(jobs.match_in_jobs, *args, 2)
    (file,) = (tmp_path / "cache").glob("pairs-*.db")
    file.write_bytes(b"not a database" * 1000)
    # The scratch folders still have the results.
    report = run_isolated(jobs.match_in_jobs, *args, 2)
    assert report == matched | {"num_cached": matched["num_pairs"]}
    assert jobs.digests(tmp_path / "matches") == jobs.digests(folder / "matches")


def test_the_list_of_pairs_is_read_as_it_was_written(tmp_path):
    chosen = PairList(pairs=[(0, 1), (0, 3)], focals={2: 0.1 + 0.2}, decisions=["so"])
    chosen.write(tmp_path)
    assert PairList.read(tmp_path) == chosen
