"""How soon the page of a scene shows it, in a browser that renders on the CPU.

    python -m benchmarks.page FOLDER [FOLDER ...] --json RECORD.json

A folder has a page, ``report.html`` or ``index.html``, as ``splatmake publish`` writes it. It is
served from this machine. A picture counts when the browser has drawn it, not when its commands are
submitted: a fence follows the draw calls of the page's WebGL context. Each run has a new browser,
which first draws with WebGL elsewhere. With several folders, runs alternate between them.
"""

from __future__ import annotations

import argparse
import functools
import gzip
import http.server
import shutil
import statistics
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.measured import add_record_options, measured, write_record
from benchmarks.record_tables import page_table
from benchmarks.results import PageResult

NAMES = ("chromium", "chromium-browser", "chrome", "google-chrome")
FLAGS = (
    *("--headless=new", "--no-sandbox", "--no-first-run"),
    *("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
)
SIZE = (1280, 800)
# Between the start of the browser and that of the page, s: the browser has started by then.
PAUSE = 4.0
# The drag that turns the scene, s.
DRAG = 5.0
TIMEOUT = 300.0

# Notes when each frame with Gaussians is submitted and drawn. Instances are batches or Gaussians.
WATCH = """
window.frames_drawn = [];
const { getContext } = HTMLCanvasElement.prototype;
HTMLCanvasElement.prototype.getContext = function (...given) {
  const gl = getContext.apply(this, given);
  if (!gl?.drawElementsInstanced || gl.watched) return gl;
  gl.watched = true;
  const { drawElementsInstanced } = gl;
  gl.drawElementsInstanced = (...call) => {
    drawElementsInstanced.apply(gl, call);
    if (!call[4]) return;
    const fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    const wait = () => gl.getSyncParameter(fence, gl.SYNC_STATUS) === gl.SIGNALED
      ? window.frames_drawn.push(performance.now()) : setTimeout(wait, 4);
    gl.flush();
    setTimeout(wait, 4);
  };
  return gl;
};
// The file with all Gaussians never arrives: its tree of levels takes both cores for long.
const { fetch } = window;
window.fetch = (url, ...given) =>
  String(url).endsWith("scene.spz") ? new Promise(() => {}) : fetch(url, ...given);
"""
FIRST = """async () => {
  while (!window.frames_drawn.length) await new Promise(done => setTimeout(done, 10));
  const [{ responseEnd }] = performance.getEntriesByType("navigation");
  return [responseEnd, window.frames_drawn[0]];
}"""
# The page's own Gaussians replace the first ones when its Gaussians are ready.
OWN = """async () => {
  await viewer.ready;
  const ready = performance.now();
  while (window.frames_drawn.at(-1) < ready - 50) await new Promise(done => setTimeout(done, 10));
  return window.frames_drawn.find(time => time >= ready - 50);
}"""
WARM = """() => {
  const gl = document.createElement("canvas").getContext("webgl2");
  gl.clear(gl.COLOR_BUFFER_BIT);
  gl.finish();
}"""


@dataclass(frozen=True)
class Times:
    """Seconds since the navigation began, and frames per second while the scene turns."""

    arrived: float
    first: float
    own: float
    frames_per_s: float


class Quiet(http.server.SimpleHTTPRequestHandler):
    """Serves files without a log."""

    def log_message(self, format: str, *args: Any) -> None:
        pass


@contextmanager
def served(folder: Path) -> Iterator[str]:
    """The address of a folder."""
    handler = functools.partial(Quiet, directory=str(folder))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


def page_of(folder: Path) -> Path:
    return next(file for name in ("report.html", "index.html") if (file := folder / name).is_file())


def once(driver: Any, address: str) -> Times:
    """Open a page in a new browser."""
    chromium = next(filter(None, map(shutil.which, NAMES)), None)
    browser = driver.chromium.launch(executable_path=chromium, args=FLAGS)
    try:
        page = browser.new_page(viewport={"width": SIZE[0], "height": SIZE[1]})
        page.set_default_timeout(1000 * TIMEOUT)
        page.evaluate(WARM)
        time.sleep(PAUSE)
        page.add_init_script(WATCH)
        page.goto(address, wait_until="commit")
        arrived, first = page.evaluate(FIRST)
        own = page.evaluate(OWN)
        return Times(arrived / 1000, first / 1000, own / 1000, turned(page))
    finally:
        browser.close()


def turned(page: Any) -> float:
    """Frames per second while the mouse turns the scene."""
    middle = (SIZE[0] // 2, SIZE[1] // 2)
    page.mouse.move(*middle)
    page.mouse.down()
    drawn = page.evaluate("frames_drawn.length")
    start = time.monotonic()
    while (passed := time.monotonic() - start) < DRAG:
        page.mouse.move(middle[0] + 20 * passed, middle[1])
        time.sleep(0.02)
    frames = page.evaluate("frames_drawn.length") - drawn
    page.mouse.up()
    return float(frames / passed)


def gaussians_of(file: Path) -> int | None:
    """The number of Gaussians of an SPZ file; None if there is no file."""
    if not file.is_file():
        return None
    with gzip.open(file) as stream:
        return int.from_bytes(stream.read(12)[8:], "little")


def measure(folders: Sequence[Path], runs: int) -> list[PageResult]:
    """The medians over runs that alternate between the pages."""
    from playwright.sync_api import sync_playwright

    found: dict[Path, list[Times]] = {folder: [] for folder in folders}
    with sync_playwright() as driver:
        for _ in range(runs):
            for folder, times in found.items():
                with served(folder) as address:
                    times.append(once(driver, f"{address}/{page_of(folder).name}"))
                print(folder, times[-1], file=sys.stderr, flush=True)
    return [
        PageResult(
            page=folder.name,
            gaussians=gaussians_of(folder / "report" / "scene.spz"),
            page_mb=round(page_of(folder).stat().st_size / 1e6, 2),
            runs=runs,
            arrived_s=_median([t.arrived for t in times]),
            first_s=_median([t.first for t in times]),
            first_after_arrival_s=_median([t.first - t.arrived for t in times]),
            slowest_first_s=round(max(t.first for t in times), 2),
            own_s=_median([t.own for t in times]),
            frames_per_s=_median([t.frames_per_s for t in times]),
        )
        for folder, times in found.items()
    ]


def _median(values: Sequence[float]) -> float:
    return round(statistics.median(values), 2)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.page",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("folders", type=Path, nargs="+", metavar="FOLDER")
    parser.add_argument("--runs", type=int, default=5)
    add_record_options(parser)
    asked = parser.parse_args(arguments)
    found = measure(asked.folders, asked.runs)
    print(page_table(found))
    if asked.json is not None:
        write_record(asked.json, measured("page", asked.note, arguments), found)
    return 0


if __name__ == "__main__":
    sys.exit(main())
