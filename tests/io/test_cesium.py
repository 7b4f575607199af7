"""CesiumJS reads our 3D Tiles, and shows the scene where it lies."""

from __future__ import annotations

import functools
import http.server
import io
import json
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from pipeline.geometry.geodesy import enu_axes, to_ecef
from pipeline.io.tiles3d import write_tiles3d
from pipeline.splats.arrays import GaussianArrays, GaussianRows
from pipeline.splats.init import SH_C0
from tests.browser import SECONDS, browser
from tests.io.test_independent import HERE, needs_node

__all__ = ["browser"]

#: Latitude, longitude and height of the scene's origin; the camera is HEIGHT metres above it.
PLACE, HEIGHT = np.array([30.0, -98.0, 250.0]), 150.0
#: East, north and up of three balls, and their colours.
BALLS = np.array([[0.0, 0, 0], [40, 0, 0], [0, 30, 10]])
COLOURS = np.array([[0.1, 0.1, 0.9], [0.9, 0.1, 0.1], [0.1, 0.9, 0.1]])


def balls() -> GaussianArrays:
    sh = np.zeros((3, 4, 3), np.float32)
    sh[:, 0] = (COLOURS - 0.5) / SH_C0
    return GaussianArrays(
        means=BALLS.astype(np.float32),
        log_scales=np.full((3, 3), np.log(2.0), np.float32),
        quats=np.tile(np.float32([1, 0, 0, 0]), (3, 1)),
        opacity_logits=np.full(3, 6, np.float32),
        sh=sh,
    )


class Handler(http.server.SimpleHTTPRequestHandler):
    """Serves the reader's files below /independent/, and a folder."""

    def translate_path(self, path: str) -> str:
        name = path.partition("?")[0]
        if name.startswith("/independent/"):
            return str(HERE / name.removeprefix("/independent/"))
        return super().translate_path(path)

    def log_message(self, *arguments: Any) -> None:
        pass


@pytest.fixture
def address(tmp_path: Path):
    handler = functools.partial(Handler, directory=str(tmp_path))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_address[1]}"
        server.shutdown()


def test_cesium_shows_the_scene_at_its_place_with_north_on_top(
    browser: Any, tmp_path: Path, address: str
) -> None:
    needs_node("cesium")
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = enu_axes(PLACE), to_ecef(PLACE)
    write_tiles3d(tmp_path / "tiles", GaussianRows(balls(), np.arange(3), 1), matrix)
    latitude, longitude, height = PLACE
    with browser.new_context(viewport={"width": 320, "height": 240}) as context:
        context.set_default_timeout(1000 * SECONDS)
        page = context.new_page()
        page.goto(f"{address}/independent/cesium.html")
        place = json.dumps([f"{address}/tiles/tileset.json", longitude, latitude, height + HEIGHT])
        page.evaluate(f"show(...{place})")
        picture, end = np.zeros((240, 320, 3)), time.monotonic() + SECONDS
        # The Gaussians are sorted and drawn some frames after their tile is there.
        while picture.max() < 128 and time.monotonic() < end:
            time.sleep(0.2)
            picture = np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB"), float)
        state = page.evaluate("state()")
    assert state["failed"] == [] and state["loaded"] and state["tiles"] == 1
    away = HEIGHT - BALLS[:, 2]
    x = 160 + state["focal"] * BALLS[:, 0] / away
    y = 120 - state["focal"] * BALLS[:, 1] / away
    for column, row, colour in zip(x, y, COLOURS, strict=True):
        around = picture[round(row) - 6 : round(row) + 7, round(column) - 6 : round(column) + 7]
        weight = around.max(2)
        centre = [(weight.sum(axis) * np.arange(-6, 7)).sum() / weight.sum() for axis in (0, 1)]
        assert np.abs(centre).max() < 1, f"the ball of {colour} is beside its place"
        assert np.abs(around.reshape(-1, 3).max(0) / 255 - colour).max() < 0.06
