"""Times of a cluster's jobs."""

from benchmarks.slurm import JobTimes, blocks_span, covered


def test_overlapping_jobs_count_once() -> None:
    assert covered([(10.0, 20.0), (12.0, 15.0), (18.0, 25.0), (30.0, 31.0)]) == 16.0
    assert covered([]) == 0.0


def test_the_training_of_blocks_is_from_the_first_start_to_the_last_end() -> None:
    lines = [
        "2026-11-26T00:00:00|2026-11-26T00:01:00|rule_coarse_wildcards_demo",
        "2026-11-26T00:01:10|2026-11-26T00:02:00|rule_block_wildcards_demo_1",
        "2026-11-26T00:01:11|2026-11-26T00:01:30|rule_block_wildcards_demo_2",
        "2026-11-26T00:02:10|2026-11-26T00:02:20|rule_polish_wildcards_demo_1",
        "2026-11-26T00:02:10|2026-11-26T00:02:30|rule_polish_wildcards_demo_2",
        "2026-11-26T00:02:40|2026-11-26T00:03:00|",
    ]
    jobs = [JobTimes.parse(line) for line in lines]
    assert blocks_span(jobs) == 80.0
    assert blocks_span(jobs[:1]) is None
