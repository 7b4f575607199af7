"""A batch through Snakemake: two scenes, one of them broken, two configurations."""

from __future__ import annotations

import csv
import json
import re
import shutil
from pathlib import Path

import pytest
from PIL import Image

from tests.e2e import transcripts
from tests.e2e.harness import TINY, make_project, make_scene, rules_run, snakemake
from tests.videos import texture

pytestmark = pytest.mark.slow

TABLE = "results/benchmark.csv"
CONFIG = TINY | {
    "train": {"steps": 60, "density": {"max_gaussians": 6_000}},
    "configs": {"plain": {}, "sh0": {"train": {"sh_degree": 0}}},
}


def rows(project) -> dict[str, dict[str, str]]:
    with open(project / TABLE) as file:
        return {f"{row['scene']}@{row['config']}": row for row in csv.DictReader(file)}


def in_one_order(text: str) -> str:
    """What a batch prints, in which the runs may end in any order."""
    plans, middle, end = text.partition("\n\n")
    ended, stages, tables = re.sub(
        r"^(good@).*: (?=PSNR)", r"\1<config>: <verdict>: ", end, flags=re.M
    ).partition("22 of 42 stages")
    ended = re.sub(r"broken@(plain|sh0)", "broken@<config>", ended)
    lines = sorted(ended.splitlines(), key=lambda line: line.lstrip())
    return plans + middle + "\n".join(lines) + f"\n{stages}{tables}"


def strip(folder: Path, count: int) -> None:
    """Photographs of which each overlaps with the next by two pixels."""
    folder.mkdir(parents=True)
    wide = texture(size=(160 * count, 120))
    for i in range(count):
        Image.fromarray(wide[:, 158 * i : 158 * i + 160]).save(folder / f"{i}.png")


def test_a_batch_goes_on_when_a_scene_fails_and_shares_what_is_the_same(tmp_path):
    project = make_project(tmp_path / "project")
    small = ("--views", "15", "--size", "100x76")
    make_scene(project, "good", "--poses", "colmap", "--distortion", "none", *small)
    strip(project / "data/broken/images", 4)
    (project / "data/notes").mkdir()

    failed = snakemake(project, TABLE, config=CONFIG, check=False)
    assert failed.returncode != 0
    assert "Traceback" not in failed.stdout, failed.stdout
    transcripts.check("batch", in_one_order(failed.stdout), lines=60)
    blamed = set(re.findall(r"^error in \w+ of (\S+):", failed.stdout, re.M))
    assert blamed == {"broken@plain", "broken@sh0"}
    assert not list(project.glob("results/broken*/metrics.json"))
    assert not list(project.glob("results/broken*/.scratch/*/*/out")), "half output was left"
    found = rows(project)
    assert {name: row["status"] for name, row in found.items()} == {
        "broken@plain": "failed",
        "broken@sh0": "failed",
        "good@plain": "ok",
        "good@sh0": "ok",
        "notes@plain": "left out",
        "notes@sh0": "left out",
    }
    assert found["broken@plain"]["failed_stage"] in ("matches", "sfm")
    assert "what to do" in found["broken@plain"]["message"]
    assert float(found["good@plain"]["psnr"]) > 15
    assert "broken@plain" in (project / "results/index.html").read_text()
    told = json.loads((project / "results/benchmark.json").read_text())
    assert told["configs_over_scenes"] == ["good"]

    # What differs in training alone shares what comes before it.
    init = "results/good@{}/init/run.json"
    taken = [json.loads((project / init.format(c)).read_text()) for c in ("plain", "sh0")]
    assert sum("taken_from" in run for run in taken) == 1

    # Tables of half a batch are made again though no run is new, and then nothing is left to do.
    shutil.rmtree(project / "data/broken")
    done = snakemake(project, TABLE, config=CONFIG)
    assert rules_run(done) == {"benchmark"}
    assert {row["status"] for row in rows(project).values()} == {"ok", "left out"}
    assert not rules_run(snakemake(project, TABLE, config=CONFIG))
    assert "the batch is up to date" in snakemake(project, "-n", TABLE, config=CONFIG).stdout

    # A further configuration runs alone.
    more = CONFIG | {"configs": CONFIG["configs"] | {"sh1": {"train": {"sh_degree": 1}}}}
    done = snakemake(project, "-n", TABLE, config=more)
    assert set(re.findall(r"^(\S+): would run", done.stdout, re.M)) == {"good@sh1", "batch"}

    (project / "report").mkdir()
    snakemake(project, TABLE, "--report", "report/all.html", config=CONFIG)
    assert "The stages that run, with their inputs" in (project / "report/all.html").read_text()
