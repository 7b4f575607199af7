"""The time in which jobs of a cluster run."""

from benchmarks.slurm import covered


def test_overlapping_jobs_count_once() -> None:
    assert covered([(10.0, 20.0), (12.0, 15.0), (18.0, 25.0), (30.0, 31.0)]) == 16.0
    assert covered([]) == 0.0
