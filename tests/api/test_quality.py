"""What is printed of a quality says which views it is of, and what else was applied."""

from splatmake import Quality, ViewQuality

VIEWS = {"a.jpg": ViewQuality(30.0, 0.9, 0.08, None), "b.jpg": ViewQuality(34.0, 0.94, 0.06, None)}


def test_a_mean_is_shown_with_its_views_and_without_gains() -> None:
    quality = Quality(32.0, 0.92, 0.07, 0.1, VIEWS, "test views", 27.5, None)
    assert repr(quality) == (
        "Quality(PSNR 32.00 dB, SSIM 0.9200, FLIP 0.0700, LPIPS 0.1000: means over 2 test "
        "views of 30.00 to 34.00 dB; 27.50 dB without exposure gains)"
    )
    assert repr(VIEWS["a.jpg"]) == "ViewQuality(PSNR 30.00 dB, SSIM 0.9000, FLIP 0.0800)"
