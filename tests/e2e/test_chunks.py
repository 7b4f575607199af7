"""Features and matches by several jobs through Snakemake: the same results as by one."""

from __future__ import annotations

import pytest

from pipeline.runtime.record import content_digest, output_digests
from tests.e2e.harness import TINY, copy_run, snakemake, started

pytestmark = pytest.mark.slow

# The scene has 20 photographs.
CHUNKS = TINY | {"features": {"photos_per_job": 8}}


def test_a_scene_in_chunks_has_the_results_of_one_job_each(finished, tmp_path):
    project = copy_run(finished, tmp_path / "project")
    results = project / "results" / "tiny"
    before = {
        stage: (content_digest(results / stage), output_digests(results / stage))
        for stage in ("features", "matches", "sfm")
    }
    for stage in ("features", "matches"):
        (results / stage / ".stage.json").unlink()  # They are computed again.
    done = snakemake(project, "results/tiny/metrics.json", config=CHUNKS)
    jobs = started(done)
    assert (jobs["extract"], jobs["pairs"], jobs["match"]) == (3, 1, 3)
    after = {
        stage: (content_digest(results / stage), output_digests(results / stage))
        for stage in before
    }
    assert after == before
    for stage in ("sfm", "train"):
        log = (results / "logs" / f"{stage}.log").read_text()
        assert f"{stage}: up to date, nothing to do" in log
    assert not started(snakemake(project, "results/tiny/metrics.json", config=CHUNKS))
