"""How soon PlayCanvas's engine shows a Streamed SOG in a browser that renders on the CPU, and how
many Gaussians it holds.

    python -m benchmarks.streamed results/NAME --budget 300000 --json RECORD.json

Opens ``export/sog_lod`` of a finished scene from one of its cameras, in a new browser for each run,
which first draws with WebGL elsewhere. The engine is that of ``tests/io/independent``: run ``make
test-packages`` before.
"""

from __future__ import annotations

import argparse
import functools
import http.server
import json
import math
import shutil
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from benchmarks.measured import add_record_options, measured, write_record
from benchmarks.page import FLAGS, NAMES, PAUSE, SIZE, TIMEOUT, WARM
from benchmarks.record_tables import streamed_table
from benchmarks.results import StreamedResult
from pipeline.io.camera_files import read_cameras
from pipeline.io.streamed_sog import LOD_META, LodMeta
from pipeline.scene.views import View, camera_views

ENGINE = Path(__file__).parents[1] / "tests/io/independent"
# The picture is complete once the engine has had nothing to load for this time, s.
SETTLED = 2.0
POLL = 0.1


class Handler(http.server.SimpleHTTPRequestHandler):
    """Serves the scene under /scene, and the page and the packages, without a log."""

    def __init__(self, *arguments: Any, scene: Path) -> None:
        self.scene = scene
        self.extensions_map = {**self.extensions_map, ".mjs": "text/javascript"}
        super().__init__(*arguments, directory=str(ENGINE))

    def translate_path(self, path: str) -> str:
        start = "/scene/"
        if path.startswith(start):
            return str(self.scene / path[len(start) :])
        return super().translate_path(path)

    def log_message(self, *_: Any) -> None: ...


@contextmanager
def served(scene: Path) -> Iterator[str]:
    """The address of the page that opens a Streamed SOG."""
    handler = functools.partial(Handler, scene=scene)
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        try:
            yield f"http://127.0.0.1:{server.server_port}/streamed.html?url=/scene/{LOD_META}"
        finally:
            server.shutdown()


@dataclass(frozen=True)
class Run:
    """Seconds since the navigation began, and the largest numbers of Gaussians."""

    first: float
    complete: float
    drawn: int
    resident: int


def pose_of(view: View) -> str:
    """The part of the address that opens the scene from a view."""
    world = np.linalg.inv(view.world_to_camera)[:3]
    angle = math.degrees(2 * math.atan(0.5 * view.height / view.fy))
    return f"pose={','.join(f'{x:.9g}' for x in world.ravel())}&fov={angle:.6g}"


def once(driver: Any, address: str, picture: Path | None) -> Run:
    """Open the scene in a new browser."""
    chromium = next(filter(None, map(shutil.which, NAMES)), None)
    browser = driver.chromium.launch(executable_path=chromium, args=FLAGS)
    try:
        page = browser.new_page(viewport={"width": SIZE[0], "height": SIZE[1]})
        page.set_default_timeout(1000 * TIMEOUT)
        page.evaluate(WARM)
        time.sleep(PAUSE)
        page.goto(address, wait_until="commit")
        page.wait_for_function("window.state?.first")
        if picture is not None:
            page.screenshot(path=picture.with_suffix(".first.png"))
        shown, since, end = -1, 0.0, time.monotonic() + TIMEOUT
        while time.monotonic() < end:
            now, state = page.evaluate("[performance.now() / 1000, state]")
            if state["shown"] != shown or not state["ready"]:
                shown, since = state["shown"], now
            elif now - since > SETTLED:
                break
            time.sleep(POLL)
        if state["errors"]:
            raise RuntimeError(f"the engine reports: {state['errors']}")
        if picture is not None:
            page.screenshot(path=picture)
        return Run(state["first"] / 1000, since, state["most"], state["resident"])
    finally:
        browser.close()


def measure(folder: Path, budget: int, runs: int, picture: Path | None) -> StreamedResult:
    """Open the Streamed SOG of a finished scene several times."""
    from playwright.sync_api import sync_playwright

    scene = folder / "export" / "sog_lod"
    meta = LodMeta.model_validate_json((scene / LOD_META).read_text("utf-8"))
    views = camera_views(read_cameras(folder / "export" / "transforms.json", exported=True), None)
    found: list[Run] = []
    with sync_playwright() as driver, served(scene) as address:
        for _ in range(runs):
            query = f"{address}&budget={budget}&{pose_of(views[0])}"
            found.append(once(driver, query, picture))
            print(found[-1], file=sys.stderr, flush=True)
    package = ENGINE / "node_modules/playcanvas/package.json"
    version = json.loads(package.read_text("utf-8"))["version"]
    return StreamedResult(
        scene=folder.name,
        gaussians=meta.counts[0],
        files=len(meta.filenames) + (meta.environment is not None),
        file_mb=round(sum(f.stat().st_size for f in scene.rglob("*") if f.is_file()) / 1e6, 1),
        engine=f"PlayCanvas {version}",
        budget=budget,
        runs=runs,
        first_s=round(median(run.first for run in found), 2),
        slowest_first_s=round(max(run.first for run in found), 2),
        complete_s=round(median(run.complete for run in found), 2),
        most_drawn=max(run.drawn for run in found),
        most_resident=max(run.resident for run in found),
    )


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.streamed",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("folder", type=Path, metavar="results/NAME")
    add("--budget", type=int, default=300_000, help="limit of the drawn Gaussians")
    add("--runs", type=int, default=3)
    add("--picture", type=Path, metavar="FILE.png", help="where to write the last picture")
    add_record_options(parser)
    asked = parser.parse_args(arguments)
    found = [measure(asked.folder, asked.budget, asked.runs, asked.picture)]
    print(streamed_table(found))
    if asked.json is not None:
        write_record(asked.json, measured("streamed", asked.note, arguments), found)
    return 0


if __name__ == "__main__":
    sys.exit(main())
