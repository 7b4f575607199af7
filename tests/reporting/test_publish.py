"""A published folder has the page and what it offers, and replaces nothing else."""

from pathlib import Path

import pytest

from pipeline.io.spz import decode_spz
from pipeline.reporting.page import write_report
from pipeline.reporting.publish import downloads, publish
from pipeline.reporting.space import FULL
from pipeline.runtime.errors import UserError
from tests.reporting.made import gaussians, report, trained


@pytest.fixture
def scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr("pipeline.reporting.page.viewer_script", str)
    exports = tmp_path / "scene" / "export"
    exports.mkdir(parents=True)
    for name in ("point_cloud.ply", "my mesh & co.glb", "stage.json", "frame.json"):
        (exports / name).write_text(name)
    (exports / "sparse").mkdir()
    write_report(report(downloads=downloads(exports)), exports.parent / "report.html")
    return exports.parent


def test_the_page_and_its_files_are_published_again_and_again(scene: Path, tmp_path: Path) -> None:
    target = tmp_path / "upload" / "barn"
    for _ in range(2):
        lines = publish(scene, target)
        found = sorted(p.relative_to(target).as_posix() for p in target.rglob("*") if p.is_file())
        assert found == ["export/my mesh & co.glb", "export/point_cloud.ply", "index.html"]
        assert (target / "index.html").read_bytes() == (scene / "report.html").read_bytes()
        assert [line for line in lines if line.endswith("point_cloud.ply")]
        assert [p.name for p in target.parent.iterdir()] == ["barn"]
        (target / "export" / "old.ply").write_text("of an earlier export")


def test_a_folder_of_something_else_and_incomplete_scenes_are_refused(
    scene: Path, tmp_path: Path
) -> None:
    taken = tmp_path / "taken"
    taken.mkdir()
    (taken / "index.html").write_text("mine")
    for target, words in [(taken, "first: index.html"), (scene / "report.html", "found a file")]:
        with pytest.raises(UserError, match=words):
            publish(scene, target)
    assert (taken / "index.html").read_text() == "mine"
    with pytest.raises(UserError, match="found none"):
        publish(taken, tmp_path / "new")
    (scene / "export" / "point_cloud.ply").unlink()
    with pytest.raises(UserError, match="missing"):
        publish(scene, tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_the_gaussians_of_a_large_scene_are_published_beside_the_page(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """More than the page has: all of them, in the file that the page loads on a web server."""
    monkeypatch.setattr("pipeline.reporting.fit.MAX_GAUSSIANS", 100)
    monkeypatch.setattr("pipeline.reporting.space.MAX_GAUSSIANS", 100)
    large = report(trained=trained(gaussians=gaussians(400)))
    write_report(large, scene / "report" / "report.html")
    (scene / "report" / "report.html").replace(scene / "report.html")
    html = (scene / "report.html").read_text("utf-8")
    assert "the 100 most prominent" in html and "connect-src 'self'" in html
    publish(scene, tmp_path / "barn")
    assert len(decode_spz((tmp_path / "barn" / FULL).read_bytes())) == 400
    publish(scene, tmp_path / "barn")
