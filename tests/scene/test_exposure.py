"""Exposure gains, as train writes and evaluate reads them."""

from pathlib import Path

import numpy as np
import pytest

from pipeline.runtime.errors import UserError
from pipeline.scene.exposure import NO_GAINS, ExposureGains, ViewLight
from pipeline.scene.views import View

GAINS = ExposureGains(
    {
        "a.jpg": ViewLight(gain=(1.1, 1 / 3, 0.9), vignetting=(-0.1, -1 / 3), slope=(0.1, -0.2)),
        "b.jpg": ViewLight(gain=(0.1 + 0.2, 1.0, 1.0)),
    }
)


def test_gains_are_read_as_they_were_written(tmp_path: Path) -> None:
    GAINS.write(tmp_path)
    found = ExposureGains.read_for(tmp_path, ["b.jpg", "a.jpg"])
    assert found == GAINS and found.of("a.jpg") == GAINS.of("a.jpg")


def test_without_gains_every_view_is_known(tmp_path: Path) -> None:
    NO_GAINS.write(tmp_path)
    assert (tmp_path / "exposure.json").read_text() == "{}\n"
    assert not ExposureGains.read_for(tmp_path, ["a.jpg"])
    assert NO_GAINS.of("a.jpg") is None


def test_gains_of_other_views_are_an_error(tmp_path: Path) -> None:
    GAINS.write(tmp_path / "train")
    with pytest.raises(UserError, match=r"gains of 2 views, found none for c\.jpg") as caught:
        ExposureGains.read_for(tmp_path / "train", ["a.jpg", "c.jpg"])
    assert "--forcerun train" in str(caught.value)


def test_a_gain_has_three_channels(tmp_path: Path) -> None:
    (tmp_path / "exposure.json").write_text('{"a.jpg": {"gain": [1.0, 1.0]}}')
    with pytest.raises(UserError, match=r"exposure\.json: .*a\.jpg\.gain\.2"):
        ExposureGains.read(tmp_path)


VIEW = View("a.jpg", "", None, 60, 40, 50.0, 50.0, 33.0, 19.0, np.eye(4), False)
LIGHT = ViewLight(gain=(1.0, 2.0, 0.5), vignetting=(-0.4, -0.3), slope=(0.5, -0.25))


def test_the_factor_is_that_of_the_equation() -> None:
    found = LIGHT.factor(VIEW)
    unit = np.hypot(60, 40) / 2
    x, y = (10.5 - 33) / unit, (7.5 - 19) / unit
    squared = x * x + y * y
    power = -0.4 * squared - 0.3 * squared**2 + 0.5 * x - 0.25 * y
    np.testing.assert_allclose(found[7, 10], np.array(LIGHT.gain) * 2**power, rtol=1e-6)
    assert found.shape == (40, 60, 3) and found.dtype == np.float32


def test_a_part_and_a_smaller_size_of_a_view_have_its_light() -> None:
    whole = LIGHT.factor(VIEW)
    np.testing.assert_allclose(
        LIGHT.factor(VIEW.cropped(20, 10, 30, 20)), whole[10:30, 20:50], rtol=1e-6
    )
    half = whole.reshape(20, 2, 30, 2, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(LIGHT.factor(VIEW, (30, 20)), half, rtol=2e-3)


def test_uniform_light_is_one_factor_a_channel() -> None:
    assert ViewLight(gain=(1.0, 2.0, 0.5)).factor(VIEW).tolist() == [1.0, 2.0, 0.5]
