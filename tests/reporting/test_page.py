"""The page is one file that needs nothing else, says every number, and trusts no string."""

import base64
import dataclasses
import json
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from pipeline.reporting.cloud import cloud
from pipeline.reporting.data import Comparison, ReportData
from pipeline.reporting.page import report_html, write_report

VOID = {"meta", "link", "img", "input", "br", "hr"}
NASTY = "</script><script>alert(1)</script><img src=x onerror=alert(2)>\"'&"


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


def metrics() -> dict:
    names = ("inspect", "decode", "train")
    return {
        "scene": "barn",
        "psnr": 27.3456,
        "ssim": 0.87654,
        "lpips": 0.12347,
        "lpips_reason": "",
        "per_view": [
            {"name": "a.jpg", "psnr": 21.987, "ssim": 0.7123, "lpips": 0.2345, "render": "0.png"},
            {"name": "b.jpg", "psnr": 33.456, "ssim": 0.9321, "lpips": 0.0456, "render": "1.png"},
        ],
        "protocol": {"resolution": ["640x480"], "split": "every 8th", "ssim": "a window"},
        "num_gaussians": 123456,
        "registered_images": 47,
        "total_images": 49,
        "reprojection_error_px": 0.4567,
        "pose_error": {"rotation_median_deg": 0.0321, "centre_median": 0.00456, "auc": {"1": 0.9}},
        "stages": {
            name: {
                "wall_s": 0.0 if name == "decode" else 12.5 + i,
                "cpu_s": 0.0 if name == "decode" else 23.4 + i,
                "peak_rss_mb": 0.0 if name == "decode" else 345.0 + i,
                "skipped": name == "decode",
                "reason": f"because of {name}",
            }
            for i, name in enumerate(names)
        },
        "versions": {"torch": "2.13.0"},
        "seed": 17,
        "warnings": ["one photograph was left out", "it is dark"],
    }


def report(**changes) -> ReportData:
    rng = np.random.default_rng(0)
    rotations = np.linalg.qr(rng.normal(size=(5, 3, 3)))[0]
    photograph, render = rng.integers(0, 256, (2, 24, 32, 3), dtype=np.uint8)
    mask = np.ones((24, 32), np.uint8)
    mask[:4] = 0
    data = ReportData(
        scene="barn",
        metrics=metrics(),
        plan={"stages": {"decode": {"run": False, "reason": "no RAW"}}, "warnings": ["it is dark"]},
        decisions={"sfm": ["incremental mapper: 49 images"], "train": []},
        curve=[
            {"step": 100, "loss": 0.2345, "psnr": 17.89, "num_gaussians": 5001, "seconds": 3.0},
            {"step": 200, "loss": 0.1234, "psnr": 23.45, "num_gaussians": 7003, "seconds": 7.0},
        ],
        comparisons=[
            Comparison("worst", "a.jpg", photograph, render, mask, 21.987, 0.7123, 6),
            Comparison("best", "b.jpg", photograph, render, None, 33.456, 0.9321),
        ],
        camera_centres=rng.normal(size=(5, 3)),
        camera_rotations=rotations,
        camera_names=[f"{i}.jpg" for i in range(5)],
        camera_is_test=[True, False, False, False, False],
        points_xyz=rng.normal(size=(300, 3)),
        points_rgb=rng.integers(0, 256, (300, 3), dtype=np.uint8),
        reprojection_errors=rng.random(300),
        track_lengths=rng.integers(2, 9, 300),
    )
    return dataclasses.replace(data, **changes)


def test_every_number_is_on_the_page() -> None:
    text = Page(report_html(report())).all_text()
    shown = [
        *("27.35", "0.8765", "0.1235", "123,456", "47 / 49", "0.457", "0.0321", "0.00456"),
        *("21.99", "0.7123", "0.2345", "33.46", "0.9321", "0.0456"),
        *("12.5 s", "23.4 s", "345 MB", "14.5 s", "347 MB", "27.0 s", "2.13.0", "17"),
        *("17.89 dB", "23.45 dB", "0.1234", "7,003", "640x480", "every 8th", "a window"),
        *("because of decode", "skipped", "incremental mapper: 49 images", "300 sparse points"),
        *("1 held-out", "4 training", "1: 0.9", "one photograph was left out"),
    ]
    assert [s for s in shown if s not in text] == []


def test_the_whole_of_metrics_and_plan_is_kept_word_for_word() -> None:
    data = report()
    page = Page(report_html(data))
    found = [json.loads(t) for t in page.text if t.startswith("{\n")]
    assert found == [data.metrics, data.plan]


def test_nothing_is_asked_of_a_network() -> None:
    html = report_html(report())
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


def test_no_string_of_the_user_becomes_markup() -> None:
    nasty = metrics()
    nasty["per_view"][0]["name"] = NASTY
    nasty["warnings"] = [NASTY]
    nasty["lpips"], nasty["lpips_reason"] = None, NASTY
    nasty["protocol"] = {NASTY: NASTY, "resolution": [NASTY], "split": NASTY}
    nasty["pose_error"] = {NASTY: NASTY}
    nasty["stages"]["train"]["reason"] = NASTY
    nasty["stages"][NASTY] = nasty["stages"]["decode"]
    data = report(
        scene=NASTY,
        metrics=nasty,
        plan={"warnings": [NASTY], NASTY: NASTY},
        decisions={NASTY: [NASTY]},
        camera_names=[NASTY] * 5,
        comparisons=[dataclasses.replace(v, name=NASTY) for v in report().comparisons],
    )
    good, bad = Page(report_html(report())), Page(report_html(data))
    scripts = [sum(tag == "script" for tag, _ in page.tags) for page in (good, bad)]
    images = [sum(tag == "img" for tag, _ in page.tags) for page in (good, bad)]
    assert scripts[0] == scripts[1] and images[0] == images[1]
    assert not any(name.startswith("on") for _, attrs in bad.tags for name in attrs)
    assert NASTY in bad.all_text()
    assert json.loads(next(t for t in bad.text if t.startswith('{"points"')))["names"][0] == NASTY


@pytest.mark.parametrize(
    "changes",
    [
        {"comparisons": ()},
        {"curve": ()},
        {"curve": [{"step": 1, "loss": None, "psnr": float("nan"), "num_gaussians": 5}]},
        {"decisions": {}, "plan": {}},
        {"points_xyz": np.zeros((0, 3)), "points_rgb": np.zeros((0, 3), np.uint8)},
        {
            "camera_centres": np.zeros((0, 3)),
            "camera_rotations": np.zeros((0, 3, 3)),
            "camera_names": (),
            "camera_is_test": (),
        },
        {"reprojection_errors": np.full(7, -1.0), "track_lengths": np.zeros(0)},
        {"points_xyz": np.full((300, 3), np.nan)},
        {"camera_centres": np.zeros((5, 3)), "points_xyz": np.zeros((300, 3))},
        {"metrics": {}},
        {"metrics": metrics() | {"per_view": [], "pose_error": None, "lpips": None}},
        {"metrics": metrics() | {"registered_images": None, "reprojection_error_px": None}},
    ],
)
def test_what_is_missing_breaks_nothing(changes) -> None:
    html = report_html(report(**changes))
    Page(html)
    assert ">nan<" not in html and "NaN" not in re.sub(r"isNaN|&quot;.*?&quot;", "", html)


def test_a_page_of_nothing_at_all_is_still_a_page(tmp_path: Path) -> None:
    write_report(ReportData("empty", {}), tmp_path / "r.html")
    assert "No warnings" in Page((tmp_path / "r.html").read_text()).all_text()


def test_missing_lpips_says_why_and_shows_no_number() -> None:
    changed = metrics() | {"lpips": None, "lpips_reason": "weights not found: put them there"}
    text = Page(report_html(report(metrics=changed))).all_text()
    assert "LPIPS n/a weights not found: put them there" in text


def test_warnings_come_before_all_else_and_once() -> None:
    html = report_html(report())
    assert html.count("<li>it is dark</li>") == 1
    assert html.index('class="warnings"') < html.index("<section")


def test_the_same_data_gives_the_same_bytes(tmp_path: Path) -> None:
    write_report(report(), tmp_path / "a.html")
    write_report(report(), tmp_path / "b.html")
    assert (tmp_path / "a.html").read_bytes() == (tmp_path / "b.html").read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.html", "b.html"]


def test_the_cloud_is_upright_robust_and_keeps_distances() -> None:
    """Cameras on a ring around the origin, upright in a tilted world; one stray point."""
    rng = np.random.default_rng(0)
    tilt = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    tilt *= np.sign(np.linalg.det(tilt))
    rotations, centres = [], []
    for angle in np.linspace(0, 2 * np.pi, 12, endpoint=False):
        forward = -np.array([np.cos(angle), np.sin(angle), 0.0])
        down = np.array([0.0, 0.0, -1.0])
        rotations.append(np.stack([np.cross(down, forward), down, forward]) @ tilt.T)
        centres.append(tilt @ (-3 * forward))
    points = np.concatenate([rng.normal(0, 0.5, (200, 3)) @ tilt.T, [[1e6, 0, 0]]])
    made = cloud(
        report(
            camera_centres=np.array(centres),
            camera_rotations=np.array(rotations),
            camera_names=["x"] * 12,
            camera_is_test=[False] * 12,
            points_xyz=points,
            points_rgb=np.zeros((201, 3), np.uint8),
        )
    )
    cameras = np.array(made["cameras"])
    np.testing.assert_allclose(cameras[:, 6:9], [[0, 0, -1]] * 12, atol=1e-3)  # down is -z
    assert 0.5 < np.abs(cameras[:, :3]).max() < 1.5
    packed = np.frombuffer(base64.b64decode(made["points"]), "<i2").reshape(-1, 3)
    assert len(packed) == 200  # the stray one is left out
    xyz = packed / made["steps"]
    gaps = np.linalg.norm(xyz[1:] - xyz[:-1], axis=1)
    true = np.linalg.norm(points[1:200] - points[:199], axis=1)
    np.testing.assert_allclose(gaps / true, np.median(gaps / true), rtol=0.02)


def test_a_large_cloud_is_thinned() -> None:
    rng = np.random.default_rng(0)
    made = cloud(
        report(points_xyz=rng.normal(size=(60_000, 3)), points_rgb=np.zeros((60_000, 3), np.uint8))
    )
    assert len(base64.b64decode(made["points"])) == 25_000 * 6
    assert len(base64.b64decode(made["colours"])) == 25_000 * 3
