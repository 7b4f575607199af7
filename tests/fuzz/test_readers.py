"""A fixed number of cases of each reader; ``python -m tests.fuzz`` runs more, and survives crashes.

A finding becomes a named case of ``test_regressions``.
"""

from __future__ import annotations

import random

import pytest

from tests.fuzz.campaign import content, run
from tests.fuzz.mutations import mutated
from tests.fuzz.readers import READERS

CASES = 1000


@pytest.mark.parametrize("name", READERS)
def test_mutated_files_are_read_or_refused(name):
    cases = round(CASES * READERS[name].weight)
    outcome = run(name, range(cases))
    assert outcome.findings == {}
    if not outcome.cases:
        pytest.skip(f"not run: a package that reads {name} is missing")
    assert outcome.cases == cases
    # A campaign without accepted or without refused files tests nothing.
    assert 0 < outcome.read < cases


@pytest.mark.parametrize("name", READERS)
def test_packing_what_was_unpacked_gives_a_file_that_is_read(name, tmp_path):
    reader = READERS[name]
    for number, files in enumerate(reader.seeds()):
        folder = tmp_path / str(number)
        folder.mkdir()
        first = next(iter(files))
        for file, data in files.items():
            whole = reader.pack(reader.unpack(data)) if file == first else data
            (folder / file).write_bytes(whole)
        reader.read(folder)


def test_a_case_is_the_same_each_time():
    reader = READERS["ply"]
    seeds = list(reader.seeds())
    assert content("ply", reader, seeds, 7) == content("ply", reader, seeds, 7)
    assert content("ply", reader, seeds, 7) != content("ply", reader, seeds, 8)


def test_mutations_take_any_file():
    for seed in range(3000):
        rng = random.Random(seed)
        assert isinstance(mutated([rng.randbytes(seed % 20)], rng), bytes)
