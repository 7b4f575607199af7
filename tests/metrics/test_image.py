"""PSNR, SSIM and FLIP agree with their definitions, and masked pixels are excluded."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from pipeline.metrics.flip import flip
from pipeline.metrics.image import PSNR_CAP, psnr, ssim
from pipeline.runtime.errors import UserError


def pair(height: int = 37, width: int = 29, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:height, :width]
    waves = np.stack([np.sin(x / 3), np.cos(y / 4), np.sin((x + y) / 5)], -1)
    reference = 0.5 + 0.4 * waves
    return np.clip(reference + rng.normal(0, 0.08, reference.shape), 0, 1), reference


def test_psnr_by_hand() -> None:
    reference = np.full((4, 5, 3), 0.25)
    assert psnr(reference + 0.1, reference) == pytest.approx(20.0, abs=1e-12)
    one_wrong = reference.copy()
    one_wrong[0, 0, 0] += 0.5
    assert psnr(one_wrong, reference) == pytest.approx(-10 * np.log10(0.25 / 60), abs=1e-12)


def test_identical_pictures_have_finite_scores() -> None:
    image, _ = pair()
    assert psnr(image, image) == PSNR_CAP
    assert psnr(image, image + 1e-9) == PSNR_CAP
    assert ssim(image, image) == pytest.approx(1.0, abs=1e-12)
    assert ssim(np.zeros((12, 12, 3)), np.zeros((12, 12, 3))) == 1.0


def test_float32_and_float64_agree() -> None:
    image, reference = pair()
    assert psnr(image.astype(np.float32), reference.astype(np.float32)) == pytest.approx(
        psnr(image, reference), abs=1e-4
    )


@pytest.mark.parametrize("seed", range(3))
def test_valid_ssim_equals_scikit_image(seed: int) -> None:
    from skimage.metrics import structural_similarity

    image, reference = pair(seed=seed)
    expected = structural_similarity(
        image,
        reference,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
        channel_axis=2,
    )
    assert ssim(image, reference, padding="valid") == pytest.approx(expected, abs=1e-10)


@pytest.mark.parametrize("size", [(37, 29), (11, 11), (6, 40), (1, 1)])
def test_headline_ssim_equals_a_direct_convolution(size: tuple[int, int]) -> None:
    """Zero padding, both pictures, the plain 11 x 11 sum, channel by channel."""
    from scipy.signal import convolve2d

    image, reference = pair(*size)
    offsets = np.arange(11) - 5.0
    window = np.exp(-(offsets[:, None] ** 2 + offsets[None, :] ** 2) / (2 * 1.5**2))
    window /= window.sum()

    def mean(values: np.ndarray) -> np.ndarray:
        return convolve2d(values, window, mode="same", boundary="fill", fillvalue=0.0)

    maps = []
    for x, y in zip(np.moveaxis(image, 2, 0), np.moveaxis(reference, 2, 0), strict=True):
        mx, my = mean(x), mean(y)
        vx, vy, cov = mean(x * x) - mx * mx, mean(y * y) - my * my, mean(x * y) - mx * my
        top = (2 * mx * my + 0.01**2) * (2 * cov + 0.03**2)
        maps.append(top / ((mx * mx + my * my + 0.01**2) * (vx + vy + 0.03**2)))
    assert ssim(image, reference) == pytest.approx(np.mean(maps), abs=1e-12)


def test_the_two_variants_differ() -> None:
    image, reference = pair()
    assert abs(ssim(image, reference) - ssim(image, reference, padding="valid")) > 1e-4


def byte_pair(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    image, reference = (np.rint(255 * values).astype(np.uint8) for values in pair(height, width))
    return image, reference


def flat_pair(image: tuple[int, ...], reference: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    first, second = (np.tile(np.uint8(colour), (30, 40, 1)) for colour in (image, reference))
    return first, second


# flip_evaluator.evaluate(reference / 255, image / 255, "LDR")[1] of the authors' package 1.7. It
# computes in float32, whose rounding makes features of equal pixels.
@pytest.mark.parametrize(
    ("pictures", "expected", "rounding"),
    [
        (byte_pair(37, 29), 0.154959, 2e-6),
        (byte_pair(3, 50), 0.223961, 2e-6),
        (byte_pair(90, 700), 0.149767, 2e-6),
        (flat_pair((0, 0, 255), (0, 255, 0)), 1.0, 1e-6),
        (flat_pair((255, 255, 255), (0, 0, 0)), 0.967397, 5e-5),
        (flat_pair((200, 30, 90), (190, 60, 80)), 0.230343, 5e-5),
    ],
)
def test_flip_equals_the_authors_program(pictures, expected: float, rounding: float) -> None:
    image, reference = pictures
    assert flip(image, reference) == pytest.approx(expected, abs=rounding)
    assert flip(image / 255, reference / 255) == flip(image, reference)
    assert flip(image, image) == 0.0


unit = st.floats(0, 1, width=32)


@settings(max_examples=40, derandomize=True, deadline=None)
@given(
    mask=hnp.arrays(np.uint8, (13, 14), elements=st.sampled_from([0, 1, 255])),
    junk=hnp.arrays(np.float32, (13, 14, 3), elements=unit),
    padding=st.sampled_from(["zero", "valid"]),
)
def test_masked_pixels_have_no_influence(mask, junk, padding) -> None:
    mask[6, 6] = 255
    image, reference = pair(13, 14)
    other = np.where(mask[..., None] != 0, image, junk)
    assert psnr(other, reference, mask) == psnr(image, reference, mask)
    assert ssim(other, reference, mask, padding=padding) == ssim(
        image, reference, mask, padding=padding
    )
    assert flip(other, reference, mask) == flip(image, reference, mask)


def test_masked_psnr_counts_only_unmasked_pixels() -> None:
    image, reference = pair()
    mask = np.zeros(image.shape[:2], np.uint8)
    mask[:10, :7] = 255
    assert psnr(image, reference, mask) == pytest.approx(psnr(image[:10, :7], reference[:10, :7]))
    assert flip(image, reference, mask) > 2 * flip(
        np.where(mask[..., None] != 0, image, reference), reference
    )
    everything = np.ones(image.shape[:2], bool)
    assert psnr(image, reference, everything) == pytest.approx(psnr(image, reference), abs=1e-12)
    assert ssim(image, reference, everything) == pytest.approx(ssim(image, reference), abs=1e-12)


def test_empty_masks_and_too_small_images_are_rejected() -> None:
    image, reference = pair(12, 12)
    nothing = np.zeros((12, 12), bool)
    for measure in (psnr, ssim, flip):
        with pytest.raises(UserError, match="no pixel"):
            measure(image, reference, nothing)
    border_only = np.ones((12, 12), bool)
    border_only[5:7, 5:7] = False
    with pytest.raises(UserError, match="no pixel"):
        ssim(image, reference, border_only, padding="valid")
    with pytest.raises(UserError, match="11 x 11"):
        ssim(image[:10], reference[:10], padding="valid")


def test_shapes_must_agree() -> None:
    image, reference = pair()
    with pytest.raises(ValueError):
        psnr(image, reference[:-1])
    with pytest.raises(ValueError):
        ssim(image, reference, np.ones((3, 3), bool))


@pytest.mark.parametrize("padding", ["zero", "valid"])
@pytest.mark.parametrize("masked", [False, True])
def test_measures_do_not_depend_on_the_bands(monkeypatch, masked: bool, padding) -> None:
    image, reference = byte_pair(101, 57)
    mask = np.random.default_rng(1).random(image.shape[:2]) > 0.3 if masked else None
    whole = psnr(image / 255, reference / 255, mask), ssim(image, reference, mask, padding=padding)
    whole_flip = flip(image, reference, mask)
    for pixels in (1, 57 * 13):
        monkeypatch.setattr("pipeline.metrics.image._BAND_PIXELS", pixels)
        assert psnr(image, reference, mask) == whole[0]
        assert ssim(image, reference, mask, padding=padding) == whole[1]
        assert flip(image, reference, mask) == whole_flip
