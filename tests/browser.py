"""A browser for tests of pages, which renders on the CPU."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from typing import Any

import pytest

from tests.tools import need_package

FLAGS = (
    *("--headless=new", "--no-sandbox", "--no-first-run"),
    *("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
)
NAMES = ("chromium", "chromium-browser", "chromium-headless-shell", "chrome", "google-chrome")
CHROMIUM = next(filter(None, map(shutil.which, NAMES)), None)
SECONDS = 180.0  # a browser on a busy machine; a page is there within one or two on an idle one


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    need_package("playwright")
    if CHROMIUM is None:
        pytest.skip("not run: no Chromium (apt-get install chromium)")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver:
        browser = driver.chromium.launch(
            executable_path=CHROMIUM, args=FLAGS, timeout=1000 * SECONDS
        )
        yield browser
        browser.close()
