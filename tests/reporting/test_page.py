"""The page is one self-contained file with all figures, and escapes all strings."""

import dataclasses
import json
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from pipeline.coverage.record import CoverageRecord, ErrorByTrust
from pipeline.metrics.evaluation import PublishedProtocol
from pipeline.plan.values import StagePlan
from pipeline.reporting.data import BlockRun, BlocksSection, CoverageSection
from pipeline.reporting.page import report_html, write_report
from pipeline.scene.blocks import Block, BlockView, Partition
from tests.plans import record_of
from tests.reporting.made import coverage, metrics, report, ring, sparse, trained

VOID = {"meta", "link", "img", "input", "br", "hr"}
NASTY = "</script><script>alert(1)</script><img src=x onerror=alert(2)>\"'&"


@pytest.fixture(autouse=True)
def no_viewer(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replaces the viewer, which test_viewer.py tests in a browser."""
    monkeypatch.setattr("pipeline.reporting.page.viewer_script", str)


class Page(HTMLParser):
    """Tags that close what they opened, attributes, and texts."""

    def __init__(self, text: str):
        super().__init__()
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text: list[str] = []
        self.feed(text)
        self.close()
        assert not self.open, f"never closed: {self.open}"

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        assert self.open and self.open[-1] == tag, f"</{tag}> closes {self.open[-1:]}"
        self.open.pop()

    def handle_data(self, data):
        self.text.append(data)

    def all_text(self) -> str:
        return " ".join(" ".join(self.text).split())


def test_every_number_is_on_the_page() -> None:
    text = Page(report_html(report())).all_text()
    shown = [
        *("27.35", "0.8765", "0.1235", "123,456", "47 / 49", "0.457", "0.0321", "0.00456"),
        *("21.99", "0.7123", "0.2345", "33.46", "0.9321", "0.0456"),
        *("12 s", "23 s", "345 MB", "14 s", "347 MB", "27 s", "2.13.0", "17"),
        *("17.89 dB", "23.45 dB", "0.1234", "7,003", "640x480", "every 8th", "a window"),
        *("because of decode", "skipped", "incremental mapper: 49 images", "300 sparse points"),
        *("0.jpg: mean trust 0.43, PSNR 18.77 dB", "by 1: 1.2%", "41\u00b0", "3.21% of pixels"),
        *("0.77% of pixels", "13 Gaussians, near 3.jpg (13)", "\u22120.57 over 1,234 blocks"),
        *("0.222 (11.1% of blocks)", "Between 1.jpg and 2.jpg, 0.4 m higher."),
        *("63 % is unknown so far", "closes 17 % of all gaps around the scene"),
        *("1 test cameras", "4 training", "1.0: 0.9", "one photograph was left out"),
    ]
    assert [s for s in shown if s not in text] == []


def test_metrics_and_plan_are_embedded_verbatim() -> None:
    data = report()
    page = Page(report_html(data))
    found = [json.loads(t) for t in page.text if t.startswith("{\n")]
    assert found == [record.model_dump(mode="json") for record in (data.metrics, data.plan)]


def test_no_network_requests() -> None:
    html = report_html(report()).replace('xmlns="http://www.w3.org/2000/svg"', "")
    assert "http:" not in html and "https:" not in html and "//cdn" not in html
    assert "@import" not in html and "url(" not in html
    page = Page(html)
    for tag, attrs in page.tags:
        for name in ("src", "href", "action", "data", "srcset", "poster"):
            value = attrs.get(name)
            assert value is None or value.startswith(("data:", "#")), (tag, name, value)
    policies = [a["content"] for t, a in page.tags if "http-equiv" in a and t == "meta"]
    assert len(policies) == 1 and policies[0] is not None
    assert policies[0].startswith("default-src 'none'")


def nasty_coverage() -> CoverageSection:
    made = coverage()
    record = made.record
    assert record.floaters is not None and record.novel_views is not None
    changes = {
        "views": [view.model_copy(update={"name": NASTY}) for view in record.views],
        "viewpoints": [v.model_copy(update={"description": NASTY}) for v in record.viewpoints],
        "floaters": record.floaters.model_copy(update={"by_camera": {NASTY: 1}}),
        "novel_views": record.novel_views.model_copy(
            update={"worst": record.novel_views.worst.model_copy(update={"near": NASTY})}
        ),
    }
    return dataclasses.replace(made, record=record.model_copy(update=changes))


def test_viewpoints_are_on_the_map_of_cameras() -> None:
    page = Page(report_html(report()))
    marks = [a.get("class") for tag, a in page.tags if tag == "circle" and "class" in a]
    assert [marks.count(kind) for kind in ("train", "test", "next")] == [4, 1, 1]


def test_the_worst_novel_view_is_shown_with_its_contradictions() -> None:
    text = Page(report_html(report())).all_text()
    assert "3.4 % of what one sees beside the photographs' places contradicts them" in text
    assert "The worst place is beside 2.jpg, with 12.3 % contradicted" in text
    assert "contradicted in 10 novel views" in text and "beside 5.7%, behind 0.0%" in text


def test_components_and_what_would_join_them_are_on_the_page() -> None:
    parts = [
        {
            "photographs": names,
            "num_points": points,
            "mean_reprojection_error_px": 0.25,
            "verdict": "good",
            "reasons": [],
            "folder": folder,
        }
        for names, points, folder in (
            (["a.jpg", "c.jpg"], 4321, "sparse/0"),
            (["d.jpg", "f.jpg", "g.jpg"], 876, "other_models/1"),
        )
    ]
    gap = {"placed": "c.jpg", "other": "d.jpg", "component": 1, "matches": 9}
    found = metrics(components=parts, gaps=[gap])
    text = Page(report_html(report(metrics=found))).all_text()
    assert "1 3 876 0.25 px good sfm/other_models/1 d.jpg, g.jpg" in text
    assert "Between c.jpg and d.jpg: joins component 1 (3 photographs)" in text
    assert "sfm.component" in text


def test_no_string_of_the_user_becomes_markup() -> None:
    plain = metrics()
    stages = {
        name: stage.model_copy(update={"reason": NASTY}) for name, stage in plain.stages.items()
    }
    published = PublishedProtocol(benchmark=NASTY, scene=NASTY, deviations=(NASTY,))
    changes = {"resolution": (NASTY,), "split": NASTY, "ssim": NASTY, "published": published}
    nasty = metrics(
        scene=NASTY,
        input=NASTY,
        per_view=[view.model_copy(update={"name": NASTY}) for view in plain.per_view],
        warnings=[NASTY],
        lpips=None,
        lpips_reason=NASTY,
        protocol=plain.protocol.model_copy(update=changes),
        stages={**stages, NASTY: stages["decode"]},
        versions={NASTY: NASTY},
    )
    data = report(
        metrics=nasty,
        plan=record_of({NASTY: StagePlan(run=True, reason=NASTY)}, [NASTY]),
        decisions={NASTY: [NASTY]},
        trained=trained(views=[dataclasses.replace(v, name=NASTY) for v in ring()]),
        coverage=nasty_coverage(),
        comparisons=[dataclasses.replace(v, name=NASTY) for v in report().comparisons],
    )
    views = [dataclasses.replace(v, name="0.jpg") for v in report().comparisons]
    good, bad = Page(report_html(report(comparisons=views))), Page(report_html(data))
    scripts = [sum(tag == "script" for tag, _ in page.tags) for page in (good, bad)]
    images = [
        sum(tag == "img" and attrs.get("class") != "poster" for tag, attrs in page.tags)
        for page in (good, bad)
    ]
    assert scripts[0] == scripts[1] and images[0] == images[1]
    assert not any(name.startswith("on") for _, attrs in bad.tags for name in attrs)
    assert NASTY in bad.all_text()
    drawn = json.loads(next(t for t in bad.text if t.startswith('{"frame"')))
    assert drawn["cameras"][0]["name"] == NASTY


def no_test_views() -> CoverageSection:
    error = ErrorByTrust(num_blocks=0, block_px=8, rank_correlation=None, by_trust=())
    changes = {"views": (), "viewpoints": (), "error": error, "novel_views": None}
    return CoverageSection(coverage().record.model_copy(update=changes), {})


NO_SURFACE = CoverageRecord(
    num_training_views=3,
    num_rendered_views=3,
    trust_definition="precision times support",
    reason="the scene shows no surface",
)


@pytest.mark.parametrize(
    "changes",
    [
        {"comparisons": ()},
        {"curve": ()},
        {"decisions": {}},
        {"points": sparse(np.zeros((0, 3)))},
        {"points": sparse(np.full((300, 3), np.nan))},
        {"coverage": CoverageSection(NO_SURFACE, {})},
        {"coverage": no_test_views()},
        {"trained": trained(views=[])},
        {"trained": trained(views=ring()[:1] * 5), "points": sparse(np.zeros((300, 3)))},
        {"metrics": metrics(per_view=[], pose_error=None, lpips=None)},
        {"metrics": metrics(registered_images=None, reprojection_error_px=None)},
    ],
)
def test_missing_values_are_accepted(changes) -> None:
    html = report_html(report(**changes))
    Page(html)
    apart = re.sub(r"&#34;.*?&#34;", "", html)
    assert ">nan<" not in html and not re.search(r"(?<![\w+/])NaN(?![\w+/=])", apart)


def test_what_was_not_measured_has_one_line_and_no_card() -> None:
    changed = metrics(lpips=None, lpips_reason="weights not found: put them there", warnings=[])
    html = report_html(report(metrics=changed))
    text = Page(html).all_text().split("{ }")[0]
    assert "LPIPS was not measured: weights not found." in text
    assert "n/a" not in html.split("<details")[0] and 'class="warnings"' not in html


def test_stages_are_in_order_beside_the_picture_of_the_plan() -> None:
    html = report_html(report())
    rows = re.findall(r"<tr><td>(\w+)</td>", html[html.index('id="stages"') :])
    assert rows == ["inspect", "train"] and '<svg class="plan"' in html


def test_resumed_work_has_no_cpu_time_of_one_session_beside_the_wall_time_of_all() -> None:
    stages = dict(metrics().stages)
    stages["train"] = stages["train"].model_copy(update={"cpu_s": None})
    text = Page(report_html(report(metrics=metrics(stages=stages)))).all_text()
    assert "CPU time of the earlier ones is not recorded" in text and "CPU 48.8 s" not in text


def test_photographs_have_their_own_names() -> None:
    """In views, measures, pictures, coverage and texts; the records stay as their files are."""
    names = {f"{i}.jpg": f"{i}.CR2" for i in range(5)} | {"a.jpg": "a.CR2", "b.jpg": "b.CR2"}
    warnings = ["sfm: 2 photographs have no pose: a.jpg, b.jpg"]
    html = report_html(report(photographs=names, metrics=metrics(warnings=warnings)))
    records = html.index("<details><summary>metrics.json")
    assert not re.findall(r"(?<!\w)[0-9ab]\.jpg", html[:records])
    assert {"a.CR2", "1.CR2", "4.CR2"} <= set(re.findall(r"\w\.CR2", html[:records]))
    assert "a.jpg" in html[records:]


def test_a_deviation_from_a_published_protocol_is_at_the_top() -> None:
    def lead(*deviations: str) -> str:
        benchmark = {"benchmark": "NeRF-synthetic", "scene": "lego", "deviations": deviations}
        published = PublishedProtocol.model_validate(benchmark)
        protocol = metrics().protocol.model_copy(update={"published": published})
        return report_html(report(metrics=metrics(protocol=protocol))).split("<nav>")[0]

    text = "lego of NeRF-synthetic, NOT as published: 40 test views, not 200"
    assert text in lead("40 test views, not 200")
    assert "lego of NeRF-synthetic, measured as published" in lead()


def test_warnings_come_first_and_once() -> None:
    html = report_html(report())
    assert html.count("<li>it is dark</li>") == 1
    assert html.index("What to know") < html.index("<section")


def test_the_same_data_gives_the_same_bytes(tmp_path: Path) -> None:
    write_report(report(), tmp_path / "a.html")
    write_report(report(), tmp_path / "b.html")
    assert (tmp_path / "a.html").read_bytes() == (tmp_path / "b.html").read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.html", "b.html"]


def test_blocks_are_on_their_map_and_in_their_table() -> None:
    """Two blocks side by side; the outer faces of both are at infinity."""
    middle = (0.0, None, None)
    view = BlockView(name="1.jpg", window=(0, 0, 200, 150), size=(200, 150), share=0.5)
    common = {"gaussians": 9, "max_gaussians": 9, "steps": 9, "views": (view,), "overviews": ()}
    margins = {"margin_below": (0.2,) * 3, "margin_above": (0.2,) * 3}
    partition = Partition(
        axes=np.eye(3).tolist(),
        lower=(-2.0,) * 3,
        upper=(2.0,) * 3,
        blocks=(
            Block(lower=(None,) * 3, upper=middle, **common, **margins),
            Block(lower=middle, upper=(None,) * 3, **common, **margins),
        ),
    )
    runs = [BlockRun(1234, 21.5, 61.0, 345.0), BlockRun(5678, 22.5, 62.0, 346.0)]
    page = Page(report_html(report(blocks=BlocksSection(partition, runs))))
    boxes = [attrs for tag, attrs in page.tags if attrs.get("class") in ("region", "block")]
    assert [box["class"] for box in boxes] == ["region", "block"] * 2
    assert all(float(box["width"] or 0) > 0 and float(box["height"] or 0) > 0 for box in boxes)
    cameras = [attrs for _, attrs in page.tags if attrs.get("class") == "camera"]
    assert len(cameras) == sum(not view.is_test for view in ring())
    assert "1,234 21.50 dB 1 min 1 s 345 MB" in page.all_text()


@pytest.mark.parametrize("judgement", [None, "accepted", "not accepted: PSNR 24 dB <b>, 26 wanted"])
def test_the_page_shows_the_judgement_if_there_are_rules(judgement: str | None) -> None:
    text = report_html(report(judgement=judgement))
    shown = re.findall(r'<span class="judgement (\w+)">(.*?)</span>', text)
    expected = {
        None: [],
        "accepted": [("good", "Accepted")],
    }.get(judgement, [("weak", "Not accepted: PSNR 24 dB &lt;b&gt;, 26 wanted")])
    assert shown == expected
