"""``python -m benchmarks.page``: renders of a page in a browser against the rasterizer's.

make demo && python -m benchmarks.page results/demo

Needs a Chromium on PATH, and playwright (in the development extras).
"""

from __future__ import annotations

import argparse
import base64
import io
import re
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from PIL import Image

from benchmarks.measured import add_record_options, measured, write_record
from benchmarks.results import PageResult
from pipeline.io.npz import read_npz
from pipeline.metrics.image import psnr
from pipeline.metrics.protocol import choose_protocol
from pipeline.plan.posed_scene import posed_scene
from pipeline.render.views import render_view, to_bytes
from pipeline.reporting.space import upright_camera
from pipeline.runtime.errors import UserError
from pipeline.scene.views import View

FLAGS = [
    "--headless=new",
    "--no-sandbox",
    *("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
    "--no-first-run",
]
MILLISECONDS = 600_000  # the browser renders on the CPU
CAMERAS = 3


def chromium() -> str | None:
    """An installed Chromium."""
    names = ("chromium", "chromium-browser", "chromium-headless-shell", "chrome", "google-chrome")
    return next(filter(None, map(shutil.which, names)), None)


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.page", description=__doc__)
    parser.add_argument("results", type=Path, help="a finished scene, for example results/demo")
    add_record_options(parser)
    options = parser.parse_args()
    results = options.results
    browser = chromium()
    if browser is None:
        print("error: no Chromium on PATH", file=sys.stderr)
        return 2
    scene = posed_scene(results, None, None)
    gaussians = read_npz(results / "train" / "gaussians.npz")
    protocol = choose_protocol(scene.views, scene.split, scene.train)
    picks = np.linspace(0, len(scene.views) - 1, CAMERAS + 2).round().astype(int)[1:-1]
    views = [scene.views[i] for i in picks]
    ours = [
        to_bytes(render_view(gaussians, view, protocol.options(scene.train, threads=0)).rgb)
        for view in views
    ]
    page = results / "report.html"
    print(f"{page}: {page.stat().st_size / 1e6:.1f} MB, {len(gaussians)} Gaussians")
    found = []
    with TemporaryDirectory() as folder:
        swapped = Path(folder) / "ply.html"
        ply = base64.b64encode((results / "export" / "point_cloud.ply").read_bytes()).decode()
        text = page.read_text("utf-8")
        swapped.write_text(re.sub(r'(?<=id="splats">)[^<]+', ply, text), "utf-8")
        for what, file in (("the page's SPZ", page.resolve()), ("the PLY", swapped)):
            for view, own, theirs in zip(views, ours, drawn(browser, file, views), strict=True):
                found.append(PageResult(what, view.name, psnr(theirs / 255, own / 255)))
                print(f"{what} {view.name}: {found[-1].psnr:.2f} dB")
    if options.json:
        write_record(options.json, measured("page", options.note), found)
    return 0


def drawn(browser: str, page: Path, views: list[View]) -> Iterator[Any]:
    """(H, W, 3) uint8 of each view, rendered by the viewer of the page."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver:
        launched = driver.chromium.launch(executable_path=browser, args=FLAGS, timeout=MILLISECONDS)
        opened = launched.new_page(viewport={"width": 480, "height": 400})
        opened.set_default_timeout(MILLISECONDS)
        opened.goto(page.as_uri())
        opened.evaluate("viewer.ready")
        for view in views:
            url = opened.evaluate("camera => viewer.picture(camera)", upright_camera(view, 1))
            png = base64.b64decode(url.partition(",")[2])
            yield np.asarray(Image.open(io.BytesIO(png)).convert("RGB"))
        launched.close()


if __name__ == "__main__":
    try:
        sys.exit(main())
    except UserError as error:
        sys.exit(f"error: {error}")
