"""PlayCanvas's engine streams our Streamed SOG in a browser: files, budget, sky and picture."""

from __future__ import annotations

import io
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from PIL import Image

from benchmarks.streamed import served
from pipeline.io import streamed_sog
from pipeline.io.streamed_sog import write_streamed_sog
from pipeline.splats.arrays import GaussianArrays
from pipeline.splats.init import SH_C0
from pipeline.splats.reduce import reduce_gaussians
from tests.browser import SECONDS, browser
from tests.io.test_independent import needs_node

__all__ = ["browser"]

COUNT, SKY = 3000, 60
RED, BLUE, GREEN = (1.0, 0, 0), (0, 0, 1.0), (0, 1.0, 0)


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Red Gaussians on the left and blue ones on the right in front of the camera, and a green sky
    above, in leaves of up to 200."""
    needs_node("playcanvas")
    rng = np.random.default_rng(0)
    means = rng.uniform((-2.0, -0.6, 4.0), (2.0, 0.6, 5.0), (COUNT + SKY, 3))
    means[COUNT:] = rng.uniform((-40.0, -40.0, 100.0), (40.0, -25.0, 101.0), (SKY, 3))
    colours = np.where(means[:, :1] < 0, RED, BLUE)
    colours[COUNT:] = GREEN
    scales = np.full((COUNT + SKY, 3), 0.08)
    scales[COUNT:] = 4.0
    gaussians = GaussianArrays(
        means=means.astype(np.float32),
        log_scales=np.log(scales).astype(np.float32),
        quats=np.tile(np.float32([1, 0, 0, 0]), (COUNT + SKY, 1)),
        opacity_logits=np.full(COUNT + SKY, 4, np.float32),
        sh=((colours - 0.5) / SH_C0).astype(np.float32)[:, None],
    )
    folder = tmp_path_factory.mktemp("streamed")
    rows = reduce_gaussians(gaussians, 0, 0.0, True)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(streamed_sog, "LEAF", 200)
        patch.setattr(streamed_sog, "FILE", 1000)
        write_streamed_sog(
            folder,
            rows,
            sky=rows.rows >= COUNT,
            blocks=1 + (means[rows.rows, 0] > 0),
        )
    with served(folder) as found:
        yield found


def opened(
    browser: Any, address: str, budget: int, expected: int
) -> tuple[dict[str, Any], np.ndarray]:
    """What the engine did until it showed at least ``expected`` Gaussians and the sky, and the
    picture. It is ready for a moment between two levels."""
    with browser.new_context(viewport={"width": 200, "height": 160}) as context:
        page = context.new_page()
        page.set_default_timeout(1000 * SECONDS)
        failed: list[str] = []
        page.on("response", lambda r: failed.append(r.url) if r.status >= 400 else None)
        page.goto(f"{address}&budget={budget}")
        end = time.monotonic() + SECONDS
        while not (
            (state := page.evaluate("state"))["ready"]
            and state["shown"] >= expected
            and state["environment"]
        ):
            assert not state["errors"] and time.monotonic() < end, state
            time.sleep(0.1)
        picture = np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB"))
        assert not [url for url in failed if not url.endswith("favicon.ico")]
        return state, picture


def test_the_whole_scene_is_loaded_within_a_large_budget(browser: Any, address: str) -> None:
    state, picture = opened(browser, address, 100_000, COUNT + SKY)
    assert state["errors"] == [] and state["shown"] == COUNT + SKY
    assert state["environment"] and 0 in state["lods"]
    check_colours(picture)


def test_a_small_budget_is_kept_at_all_times(browser: Any, address: str) -> None:
    """The coarsest level has 188 Gaussians, and the sky is always shown."""
    state, picture = opened(browser, address, 800, 400)
    assert state["errors"] == [] and state["environment"]
    assert state["shown"] <= state["most"] <= 800 + SKY
    check_colours(picture)


def check_colours(picture: np.ndarray) -> None:
    """The scene is upright and not mirrored: the sky above, red on the left."""
    found = {}
    for name, channel in (("red", 0), ("green", 1), ("blue", 2)):
        others = np.delete(picture.astype(int), channel, 2).max(2)
        where = np.argwhere(picture[:, :, channel] > others + 80)
        assert len(where) > 300, name
        found[name] = where.mean(0)
    height, width = picture.shape[:2]
    assert found["red"][1] < 0.5 * width < found["blue"][1]
    assert found["green"][0] < 0.4 * height < found["red"][0]
