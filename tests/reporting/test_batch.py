"""Tables and page of a batch: one line per run; means over the same scenes."""

import csv
import io
import json
import re
from statistics import fmean

import pytest

from pipeline.config.runs import Run
from pipeline.plan.protocols import PUBLISHED_SCENES, benchmark_scene
from pipeline.reporting.batch import (
    PUBLISHED,
    Result,
    as_csv,
    as_json,
    by_config,
    published_for,
    row,
)
from pipeline.reporting.charts import ChartPoint, pareto_front, trade_off_chart
from pipeline.reporting.index import Batch, Thumbnail, index_html
from pipeline.reporting.metrics import TimedMetrics
from tests.reporting import made


def metrics(psnr: float, seconds: float = 10.0, photos: int = 20, **more) -> TimedMetrics:
    ran = {"wall_s": seconds, "cpu_s": 2 * seconds, "peak_rss_mb": 500.0, "reason": "so"}
    stages = {
        "decode": {"skipped": True, "reason": "no RAW files"},
        "train": ran | {"skipped": False},
        "evaluate": ran | {"skipped": False},
    }
    facts = {"psnr": psnr, "ssim": 0.9, "lpips": None, "train_psnr": psnr + 1, "stages": stages}
    return made.metrics(**facts, registered_images=photos, total_images=photos, seed=0, **more)


def protocol(**changes) -> dict:
    return made.metrics().protocol.model_dump() | changes


def done(scene: str, config: str, psnr: float, seed: int | None = None, **more) -> Result:
    machine = {"host": "box", "processor": "fast one", "cores": 4, "threads": 2, "commit": "abc"}
    return Result(Run(scene, config, seed), "ok", "", "", metrics(psnr, **more), 1.5, machine)


def failed(scene: str, config: str, seed: int | None = None) -> Result:
    said = "no <two> photographs match\n  what to do: take more"
    return Result(Run(scene, config, seed), "failed", "matches", said)


BATCH = [
    done("fox", "fast", 28.0, 0, seconds=5.0),
    done("fox", "fast", 29.0, 1, seconds=5.0),
    done("fox", "high", 32.0, 0, seconds=50),
    failed("fox", "high", 1),
    done("cat", "fast", 20.0, 0),
    failed("cat", "high", 0),
    Result(Run("notes", "fast", 0), "left out", "", "no photograph found"),
]


def test_csv_has_one_line_per_run():
    lines = list(csv.DictReader(io.StringIO(as_csv(BATCH, ["decode", "train"]))))
    assert [line["status"] for line in lines] == [r.status for r in BATCH]
    first, lost = lines[0], lines[3]
    assert float(first["psnr"]) == 28.0
    assert (first["train_wall_s"], first["decode_wall_s"], first["wall_s"]) == ("5.0", "", "10.0")
    assert (first["peak_rss_mb"], first["lpips"], first["threads"]) == ("500.0", "", "2")
    assert (first["host"], first["processor"], first["cores"]) == ("box", "fast one", "4")
    assert lost["failed_stage"] == "matches"
    assert lost["message"] == "no <two> photographs match; what to do: take more"
    assert lost["psnr"] == "" and lost["seed"] == "1"


def test_means_are_over_scenes_that_all_configurations_finished():
    scenes, over = by_config(BATCH)
    assert scenes == ["fox"]
    assert over["fast"]["psnr"].mean == 28.5 and over["high"]["psnr"].mean == 32.0
    assert "lpips" not in over["fast"]
    told = as_json(BATCH)
    assert told["scenes"]["fox"]["fast"]["psnr"] == {
        "mean": 28.5,
        "low": 28.0,
        "high": 29.0,
        "count": 2,
    }
    assert told["scenes"]["cat"].keys() == {"fast"}
    json.dumps(told, allow_nan=False)


def test_a_configuration_without_results_does_not_hide_the_others():
    scenes, over = by_config([done("fox", "fast", 28.0), failed("fox", "high")])
    assert scenes == ["fox"] and list(over) == ["fast"]


def test_a_batch_of_failures_has_a_table_and_a_page():
    lost = [failed("fox", "fast"), failed("cat", "fast")]
    assert as_csv(lost).count("failed") == 2 + 1
    assert as_json(lost)["configs"] == {}
    assert "2 runs have no result" in index_html(Batch(lost))


# --- page ---------------------------------------------------------------------------------


def test_the_page_shows_links_failures_and_seeds_without_requests():
    thumb = Thumbnail("data:image/jpeg;base64,AAAA", 4, 3, "a.jpg")
    page = index_html(Batch(BATCH, {"fox@fast@seed0": thumb}, {"fox": thumb}))
    links = re.findall(r'href="([^"#]*)"', page)
    assert {"fox%40fast%40seed0/report.html", "cat%40fast%40seed0/report.html"} <= set(links)
    assert not any(link.startswith(("http", "//")) for link in links)
    assert "28.50 <small>±0.50</small>" in page
    assert "no &lt;two&gt; photographs match" in page and "<two>" not in page
    assert "3 runs have no result" in page
    assert page.count("data:image/jpeg") == 2
    assert "as configured" in index_html(Batch([done("fox", "", 28.0)]))


def test_the_page_warns_about_different_image_sizes():
    """PSNR at 640 and 800 pixels is not comparable; sizes may differ between scenes."""

    def page(*runs: tuple[str, str, str]) -> str:
        results = []
        for scene, config, size in runs:
            results.append(done(scene, config, 30.0, protocol=protocol(resolution=(size,))))
        return index_html(Batch(results))

    said = "images of different sizes"
    assert said in page(("fox", "fast", "64x48"), ("fox", "high", "80x60"))
    alike = [("fox", "fast", "64x48"), ("cat", "fast", "80x60")]
    assert said not in page(*alike, *((scene, "high", size) for scene, _, size in alike))


def test_names_are_escaped():
    page = index_html(Batch([done("<b>&\"'", "fast", 20.0), done("a b", "fast", 21.0)]))
    assert "<b>&" not in page
    assert "a%20b%40fast/report.html" in page


def test_the_same_batch_gives_the_same_bytes():
    assert index_html(Batch(BATCH)) == index_html(Batch(list(BATCH)))


# --- trade-off ----------------------------------------------------------------------------


def test_the_pareto_front():
    dots = [ChartPoint(s, e, f"{s}", "") for s, e in ((1, 9), (2, 5), (3, 7), (4, 5), (5, 1))]
    assert [d.seconds for d in pareto_front(dots)] == [1, 2, 5]


@pytest.mark.parametrize("dots", [[(5.0, 0.1)], [(1.0, 1.0), (1.0, 1.0)], [(1e-3, 9), (1e5, 1e-6)]])
def test_a_trade_off_stays_inside_its_frame(dots):
    named = [ChartPoint(s, e, "a rather long name of a configuration", "<tip>", i)
             for i, (s, e) in enumerate(dots)]  # fmt: skip
    svg = trade_off_chart(named, title="t", x_title="x", y_label=str)
    spots = re.findall(r'cx="([\d.-]+)" cy="([\d.-]+)"', svg)
    assert len(spots) == len(dots)
    assert all(0 <= float(x) <= 440 and 0 <= float(y) <= 250 for x, y in spots)
    assert "nan" not in svg and "<tip>" not in svg


# --- published ----------------------------------------------------------------------------


def test_published_scenes_average_to_the_papers_means():
    """The papers give means as well, which reveals wrong figures of scenes."""
    for entry in json.loads(PUBLISHED.read_text())["results"]:
        for measure, mean in entry["mean"].items() if entry["scenes"] else ():
            ours = fmean(scene[measure] for scene in entry["scenes"].values())
            assert ours == pytest.approx(mean, abs=0.0101 if measure == "psnr" else 0.00051), entry
        assert entry["source"] and entry["protocol"]


def test_a_published_scene_is_identified_by_name_and_number_of_photographs():
    named = published_for("mip360_bonsai", 292)
    assert {p["method"] for p in named} >= {"3DGS, 7k steps", "3DGS, 30k steps"}
    assert {p["psnr"] for p in named} >= {31.98}
    assert published_for("bonsai", 40) == []  # somebody's own bonsai
    assert published_for("nerf_lego", 100)[0]["psnr"] == 35.78
    assert published_for("my_garden", 185) == []
    assert as_json([done("bonsai", "fast", 25.0, photos=292)])["published"].keys() == {"bonsai"}
    page = index_html(Batch([done("bonsai", "fast", 25.0, photos=292)]))
    assert "31.98" in page and "Kerbl, Kopanas" in page


def test_runs_of_another_protocol_are_marked_beside_published_figures():
    alike = {"benchmark": "Mip-NeRF 360", "scene": "bonsai", "deviations": []}
    unlike = alike | {"deviations": ["views of 80x60 pixels, not 1559x1039"]}
    for published, marks in ((alike, 0), (unlike, 1), (None, 1)):
        how = protocol(published=published)
        page = index_html(Batch([done("bonsai", "fast", 25.0, photos=292, protocol=how)]))
        assert page.count("(not as published)") == marks
        assert ("not 1559x1039" in page) == (published is unlike)
    assert "as published" not in index_html(Batch([done("cat", "fast", 25.0)]))


def test_benchmark_scenes_are_the_published_ones():
    for benchmark, scenes in json.loads(PUBLISHED.read_text())["photographs"].items():
        measured = [s for s in PUBLISHED_SCENES.values() if s.train_views is None]
        known = {s.scene: s for s in measured if s.benchmark == benchmark}
        assert scenes.keys() == known.keys()
        for name, counts in scenes.items():
            assert known[name].every is None or tuple(counts) == known[name].photographs
    assert benchmark_scene("360_v2_Bonsai") == benchmark_scene("mipnerf360-bonsai") == "bonsai"
    assert benchmark_scene("living_room") == "living_room"


def test_columns_do_not_depend_on_the_status_of_a_run():
    assert list(row(BATCH[0])) == list(row(BATCH[3])) == list(row(BATCH[-1]))
