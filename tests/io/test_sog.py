"""SOG files: quantisation errors, reproducible bytes, folders, and errors on damaged files."""

from __future__ import annotations

import io
import json
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipeline.io import palette, sog_container
from pipeline.io.sog import count_small, encode_sog, read_sog, write_sog
from pipeline.io.sog_container import META
from pipeline.io.splat_files import is_antialiased, read_gaussians, write_gaussians
from pipeline.runtime.errors import UserError
from tests.splats.samples import Within, rotation_angle, sample

#: What docs/reference/formats.md states, and the codebooks and palette of the samples. These have
#: positions up to 9, and as many centroids as Gaussians.
OURS = Within(5e-4, 0.03, 0.5001 / 255, 1.1, 0.02, 0.02)


def members(path: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def written(path: Path, files: dict[str, bytes]) -> Path:
    path.write_bytes(sog_container.pack(files))
    return path


def with_meta(files: dict[str, bytes], *changes: tuple[str, object]) -> dict[str, bytes]:
    """The files with other values in ``meta.json``, named by their path in it."""
    meta = json.loads(files[META])
    for path, value in changes:
        *outer, last = path.split(".")
        at = meta
        for key in outer:
            at = at[key]
        at[last] = value
    return files | {META: json.dumps(meta).encode()}


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("count", [1, 256])
def test_round_trip_stays_within_the_stated_quantisation(tmp_path, count, degree) -> None:
    gaussians = sample(count, degree)
    write_sog(tmp_path / "a.sog", gaussians)
    OURS.check(read_sog(tmp_path / "a.sog"), gaussians)


def test_rotations_survive_whichever_component_is_largest(tmp_path) -> None:
    gaussians = sample(4000, 0)
    edge = np.array([[1, 0, 0, 0], [0, -1, 0, 0], [1, 1, 1, -1], [0, 0, 1, -1], [-3, 0, 0, 0]])
    gaussians.quats[: len(edge)] = gaussians.quats.new_tensor(edge)
    write_sog(tmp_path / "a.sog", gaussians)
    found = read_sog(tmp_path / "a.sog")
    assert rotation_angle(found, gaussians).max() <= OURS.degrees
    assert np.allclose(found.quats.norm(dim=1), 1, atol=1e-6)


@pytest.mark.parametrize("unit", [1e-4, 1.0, 1e4])
def test_positions_have_sixteen_bits_of_their_logarithm(tmp_path, unit) -> None:
    gaussians = sample(300, 0)
    gaussians.means *= unit
    write_sog(tmp_path / "a.sog", gaussians)
    means = gaussians.means.numpy().astype(np.float64)
    logs = np.sign(means) * np.log1p(np.abs(means))
    step = (logs.max(0) - logs.min(0)) / 65535 * (1 + np.abs(means))
    error = np.abs(read_sog(tmp_path / "a.sog").means.numpy() - means)
    assert (error <= 0.51 * step + 1e-6 * np.abs(means)).all()


def test_equal_positions_and_colours_are_kept(tmp_path) -> None:
    gaussians = sample(30, 1)
    gaussians.means[:, 1], gaussians.sh[:], gaussians.log_scales[:] = 3.0, 0.25, -2.0
    write_sog(tmp_path / "a.sog", gaussians)
    found = read_sog(tmp_path / "a.sog")
    assert np.allclose(found.means[:, 1], 3, atol=1e-6)
    assert (found.sh == 0.25).all() and (found.log_scales == -2).all()


def test_the_same_gaussians_give_the_same_bytes(tmp_path) -> None:
    write_sog(tmp_path / "a.sog", sample(300))
    write_sog(tmp_path / "b.sog", sample(300))
    assert (tmp_path / "a.sog").read_bytes() == (tmp_path / "b.sog").read_bytes()


def test_a_folder_has_the_files_of_the_archive_and_is_read(tmp_path) -> None:
    folder = tmp_path / "scene"
    write_gaussians(folder / META, sample(300), antialias=True)
    write_gaussians(tmp_path / "a.sog", sample(300), antialias=True)
    files = {file.name: file.read_bytes() for file in folder.iterdir()}
    assert files == members(tmp_path / "a.sog")
    found = read_gaussians(folder / META, [])
    for name, values in read_gaussians(tmp_path / "a.sog", []).arrays().items():
        np.testing.assert_array_equal(values, found.arrays()[name])
    assert is_antialiased(folder / META) and is_antialiased(tmp_path / "a.sog")
    write_gaussians(tmp_path / "b.sog", sample(300))
    assert not is_antialiased(tmp_path / "b.sog")


def test_transparent_gaussians_keep_their_colour(tmp_path) -> None:
    """WebP encoders drop the colours of transparent pixels unless told otherwise."""
    gaussians = sample(20, 0)
    gaussians.opacity_logits[:] = -20
    write_sog(tmp_path / "a.sog", gaussians)
    replace(OURS, opacity=0.001).check(read_sog(tmp_path / "a.sog"), gaussians)


def test_a_palette_smaller_than_the_scene_keeps_groups_of_harmonics(tmp_path) -> None:
    rng = np.random.default_rng(0)
    gaussians, kinds = sample(1500, 3), rng.integers(0, 300, 1500)
    rest = rng.normal(0, 0.2, (300, 15, 3))[kinds] + rng.normal(0, 1e-3, (1500, 15, 3))
    gaussians.sh[:, 1:] = gaussians.sh.new_tensor(rest)
    write_sog(tmp_path / "a.sog", gaussians)
    meta = json.loads(members(tmp_path / "a.sog")[META])
    assert meta["shN"]["count"] == 1024 and meta["shN"]["bands"] == 3
    error = (read_sog(tmp_path / "a.sog").sh - gaussians.sh)[:, 1:].numpy()
    assert np.sqrt((error**2).mean()) < 0.05


def test_palettes_do_not_depend_on_the_order_of_sums(monkeypatch) -> None:
    """Distances are exact: products of other shapes give the same bits."""
    rng = np.random.default_rng(0)
    rows = rng.normal(0, 0.1, (5000, 45)).astype(np.float32)
    rows[::50] *= 40
    weights = rng.random(5000) + 0.1
    expected = palette.make_palette(rows, weights, 512)
    monkeypatch.setattr(palette, "_BLOCK", 37)
    monkeypatch.setattr(palette, "_CHUNK", 700)
    found = palette.make_palette(rows, weights, 512)
    np.testing.assert_array_equal(found.labels, expected.labels)
    np.testing.assert_array_equal(found.centroids, expected.centroids)


def test_a_palette_is_nearly_as_good_as_exhaustive_k_means() -> None:
    rng = np.random.default_rng(1)
    rows = (rng.normal(0, 1, (4096, 6)) @ rng.normal(0, 1, (6, 24))).astype(np.float32)
    made = palette.make_palette(rows, np.ones(len(rows)), 256)

    def error(centroids: np.ndarray) -> tuple[float, np.ndarray]:
        distances = ((rows[:, None] - centroids[None]) ** 2).sum(2)
        return float(distances.min(1).mean()), distances.argmin(1)

    centroids = rows[rng.choice(len(rows), 256, replace=False)].astype(np.float64)
    for _ in range(10):
        labels = error(centroids)[1]
        for i in np.unique(labels):
            centroids[i] = rows[labels == i].mean(0)
    assert ((rows - made.centroids[made.labels]) ** 2).sum(1).mean() < 1.15 * error(centroids)[0]


def test_gaussians_below_the_resolution_are_counted_and_said(tmp_path) -> None:
    gaussians = sample(200, 0)
    gaussians.log_scales[:] = -3
    assert count_small(gaussians) == 0 and write_gaussians(tmp_path / "a.sog", gaussians) == []
    gaussians.log_scales[:] = -15
    (said,) = write_gaussians(tmp_path / "a.sog", gaussians)
    assert "200 of 200 Gaussians are smaller" in said


def test_no_gaussians_are_an_error(tmp_path) -> None:
    with pytest.raises(UserError, match="expected Gaussians"):
        write_sog(tmp_path / "a.sog", sample(0))


@pytest.mark.parametrize(
    ("changes", "found"),
    [
        ([("version", 1)], "version"),
        ([("count", 0)], "count"),
        ([("count", 10**9)], "times the bytes"),
        ([("count", 200)], "expected an image of 200 pixels"),
        ([("means.mins", [0, 0])], "means.mins"),
        ([("means.maxs", [0, 0, 1e9])], "means.maxs"),
        ([("means.files", ["../x", "y"])], "means.files"),
        ([("quats.files", ["missing.webp"])], "missing.webp"),
        ([("scales.codebook", [])], "scales.codebook"),
        ([("scales.codebook", [0.0])], "indices of 1 values"),
        ([("shN.count", 1)], "indices of 1 centroids"),
        ([("shN.bands", 2)], "shN_centroids.webp"),
        ([("shN.bands", 4)], "shN.bands"),
    ],
)
def test_inconsistent_files_are_errors(tmp_path, changes, found) -> None:
    path = written(tmp_path / "a.sog", with_meta(encode_sog(sample(100)), *changes))
    with pytest.raises(UserError, match=found) as caught:
        read_sog(path)
    assert caught.value.file == path


def test_a_small_image_of_many_pixels_is_refused_before_it_is_decoded(tmp_path) -> None:
    files = encode_sog(sample(100))
    buffer = io.BytesIO()
    Image.new("RGB", (12000, 12000)).save(buffer, "WEBP", lossless=True, method=0)
    path = written(tmp_path / "a.sog", files | {"quats.webp": buffer.getvalue()})
    with pytest.raises(UserError, match="100 pixels, found 12000 x 12000"):
        read_sog(path)


def test_an_archive_that_expands_is_refused(tmp_path) -> None:
    with zipfile.ZipFile(tmp_path / "a.sog", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(META, bytes(20 << 20))
    with pytest.raises(UserError, match="larger than the archive"):
        read_sog(tmp_path / "a.sog")
