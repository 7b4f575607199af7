"""Exposure gains, as train writes and evaluate reads them."""

from pathlib import Path

import pytest

from pipeline.runtime.errors import UserError
from pipeline.scene.exposure import NO_GAINS, ExposureGains, ViewLight

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
