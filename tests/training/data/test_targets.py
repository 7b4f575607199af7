"""Training images: alpha, masks, reduced sizes, and the image stores."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from pipeline.photos.load import resize_area
from pipeline.render import RasterOptions, Surroundings, make_backend
from pipeline.render.views import raster_camera
from pipeline.scene.views import View, reduced_size
from pipeline.training.data.image_store import DiskStore, MemoryStore
from pipeline.training.data.targets import Layers, Targets, usable_factor
from tests.training.conftest import TinyScene


def view_of(path: Path, picture: np.ndarray, mask: np.ndarray | None = None) -> View:
    Image.fromarray(picture).save(path)
    mask_path = None
    if mask is not None:
        mask_path = str(path.with_suffix(".mask.png"))
        Image.fromarray(mask).save(mask_path)
    height, width = picture.shape[:2]
    pose = np.eye(4)
    return View("v", str(path), mask_path, width, height, 50.0, 50.0, 5.0, 5.0, pose, False)


def test_colours_of_transparent_and_ignored_pixels_have_no_effect(tmp_path: Path) -> None:
    picture = np.full((8, 10, 4), 200, np.uint8)
    picture[:4, :, 3] = 0
    targets = Targets([view_of(tmp_path / "a.png", picture)], threads=1)
    assert targets.have_alpha
    for factor in (1, 2, 4):
        target = targets.get(0, factor)
        over = target.over((1.0, 0.5, 0.0))
        rows = over.shape[0] // 2
        assert torch.allclose(over[:rows], torch.tensor([1.0, 0.5, 0.0]), atol=0.003)
        visible = (200 * 200 / 255 + 55 * np.array([1.0, 0.5, 0.0])) / 255
        assert np.allclose(over[rows:].numpy(), visible, atol=0.004)


def test_an_opaque_alpha_channel_is_dropped(tmp_path: Path) -> None:
    picture = np.full((8, 10, 4), 255, np.uint8)
    targets = Targets([view_of(tmp_path / "a.png", picture)], threads=1)
    assert not targets.have_alpha
    assert targets.get(0, 1).over((0.3, 0.3, 0.3)).dtype == torch.uint8


def test_a_reduced_pixel_is_the_mean_of_pixels_that_are_not_ignored(tmp_path: Path) -> None:
    picture = np.random.default_rng(0).integers(1, 255, (8, 8, 3), np.uint8)
    mask = np.full((8, 8), 255, np.uint8)
    mask[0, 0] = mask[6:, 4:] = 0
    picture[0, 0] = 255
    targets = Targets([view_of(tmp_path / "a.png", picture, mask)], threads=1)
    ignored = targets.get(0, 2).ignored
    assert ignored is not None
    wanted = np.zeros((4, 4), bool)
    wanted[3, 2:] = True
    assert np.array_equal(ignored.numpy(), wanted)
    assert not targets.get(0, 2).rgb[ignored].any()
    counting = picture[:2, :2].reshape(4, 3)[1:]
    assert np.abs(targets.get(0, 2).rgb[0, 0].numpy() - counting.mean(0)).max() <= 0.5
    assert not targets.get(0, 1).rgb[torch.from_numpy(mask == 0)].any()


def test_the_reduced_camera_renders_the_reduced_image(scene: TinyScene) -> None:
    view = replace(scene.views[1], width=39, height=33, cx=18.0, cy=17.5)
    options = RasterOptions(sh_degree=1, threads=1)
    soft = scene.truth.clone()
    soft.log_scales += 1.0  # large, so that the dilation by 0.3 pixels hardly shows
    forward = make_backend().forward
    full = forward(*soft.parameters(), raster_camera(view), options).color.numpy()
    small = forward(*soft.parameters(), raster_camera(view, 2), options).color.numpy()
    width, height = reduced_size(view, 2)
    assert small.shape == (height, width, 3)
    difference = np.abs(small - resize_area(full, width, height)).mean()
    shifted = np.abs(small[:, 1:] - resize_area(full, width, height)[:, :-1]).mean()
    assert difference < 0.01
    assert difference < 0.3 * shifted


def test_small_images_are_not_reduced() -> None:
    sizes = [(800, 533, 4), (200, 150, 2), (100, 70, 1)]
    for width, height, wanted in sizes:
        view = View("", "", None, width, height, 1.0, 1.0, 0.0, 0.0, np.eye(4), False)
        assert usable_factor([view], 4) == wanted


def test_both_image_stores_give_the_same_bits(tmp_path: Path) -> None:
    """With and without alpha and masks, at every size, repeatedly."""
    rng = np.random.default_rng(0)
    views = []
    for number, channels in enumerate((3, 4, 3)):
        picture = rng.integers(0, 255, (140 + number, 150, channels), np.uint8)
        mask = (rng.random(picture.shape[:2]) > 0.4).astype(np.uint8) * 255 if number else None
        views.append(view_of(tmp_path / f"{number}.png", picture, mask))
    in_memory = Targets(views, 3, store=MemoryStore())
    on_disk = Targets(views, 3, store=DiskStore())
    assert on_disk.have_alpha and not on_disk.hidden()
    for factor, index in [(4, 0), (4, 2), (4, 0), (2, 1), (2, 2), (1, 2), (1, 1), (1, 0), (1, 2)]:
        wanted, found = in_memory.get(index, factor), on_disk.get(index, factor)
        for name in ("rgb", "alpha", "ignored"):
            one, other = getattr(wanted, name), getattr(found, name)
            assert (one is None) == (other is None), name
            assert one is None or (one.dtype == other.dtype and torch.equal(one, other)), name


def test_a_disk_store_reads_copies_and_leaves_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    read = DiskStore().add((torch.arange(200, dtype=torch.uint8).reshape(10, 20), None))
    first, second = read(), read()
    assert first[0] is not None and second[0] is not None and first[1] is None
    assert torch.equal(first[0], second[0]) and first[0].data_ptr() != second[0].data_ptr()
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("store", [MemoryStore, DiskStore])
def test_the_layers_around_a_block_are_stored_with_its_pixels(
    tmp_path: Path, store: type[MemoryStore] | type[DiskStore]
) -> None:
    view = view_of(tmp_path / "a.png", np.full((8, 10, 3), 200, np.uint8))
    plane = torch.arange(80, dtype=torch.uint8).reshape(8, 10)
    image = plane[..., None].repeat(1, 1, 3)
    around = Surroundings(image, plane, image + 1, plane + 1, image.to(torch.int8) - 90)
    weight, window = plane / 100, plane < 10

    def layers(_: View) -> Layers:
        return Layers(around, weight, image, (0.0, 0.0, 0.0), window)

    target = Targets([view], threads=1, store=store(), layers=layers).get(0, 1)
    assert target.is_overview and target.surroundings is not None
    assert target.ignored is not None and torch.equal(target.ignored, window)
    expected_rgb = image + weight[..., None] * (200 - image.float())
    assert (target.rgb - expected_rgb).abs().max() <= 0.5
    for field in fields(Surroundings):
        found, expected = getattr(target.surroundings, field.name), getattr(around, field.name)
        assert torch.equal(found, expected) and found.dtype == expected.dtype
