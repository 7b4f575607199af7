"""The image quality of a scene's renders."""

from __future__ import annotations

from dataclasses import dataclass

from pipeline.metrics.evaluation import Evaluation


@dataclass(frozen=True)
class ViewQuality:
    """Image quality of one render against its photograph.

    Attributes:
        psnr: The PSNR in dB over the pixels that the mask leaves.
        flip: The mean FLIP error, 0 to 1; lower is better.
        lpips: The LPIPS, or None if its weights are not installed.
    """

    psnr: float
    ssim: float
    flip: float | None
    lpips: float | None

    def __repr__(self) -> str:
        return f"ViewQuality({_values(self)})"


@dataclass(frozen=True)
class Quality:
    """Image quality of several renders, as in metrics.json.

    ``psnr`` is the number to report: the mean, over the views, of each view's PSNR in dB. The PSNR
    of a single view, in ``views``, may differ from it by several dB.

    Attributes:
        psnr, ssim, flip, lpips: The means over the views. LPIPS is None if its weights are not
            installed.
        views: The quality of each view by its name.
        measured: Which views were measured: "test views", "training views" if the scene has no test
            views, or "chosen views".
        psnr_without_gains: The mean PSNR of renders that are not multiplied by the exposure gains
            of their photographs; None if exposure is not modelled, so that ``psnr`` has no gains
            either.
        psnr_without_fit: The mean PSNR, over the same half of each photograph, of renders without
            the appearance that was fitted to the photographs; None if none is.
    """

    psnr: float
    ssim: float
    flip: float | None
    lpips: float | None
    views: dict[str, ViewQuality]
    measured: str
    psnr_without_gains: float | None
    psnr_without_fit: float | None

    def __repr__(self) -> str:
        each = [view.psnr for view in self.views.values()]
        parts = f"{_values(self)}: means over {len(each)} {self.measured}"
        if len(each) > 1:
            parts += f" of {min(each):.2f} to {max(each):.2f} dB"
        for name, value in (
            ("exposure gains", self.psnr_without_gains),
            ("fitted appearance", self.psnr_without_fit),
        ):
            parts += "" if value is None else f"; {value:.2f} dB without {name}"
        return f"Quality({parts})"


def quality_of(found: Evaluation, measured: str) -> Quality:
    """The quality that an evaluation found. ``measured`` is the attribute of ``Quality``."""
    return Quality(
        psnr=found.psnr,
        ssim=found.ssim,
        flip=found.flip,
        lpips=found.lpips,
        views={
            view.name: ViewQuality(view.psnr, view.ssim, view.flip, view.lpips)
            for view in found.per_view
        },
        measured=measured,
        psnr_without_gains=found.psnr_without_gains,
        psnr_without_fit=found.psnr_without_fit,
    )


def _values(quality: ViewQuality | Quality) -> str:
    lpips = "" if quality.lpips is None else f", LPIPS {quality.lpips:.4f}"
    flip = "" if quality.flip is None else f", FLIP {quality.flip:.4f}"
    return f"PSNR {quality.psnr:.2f} dB, SSIM {quality.ssim:.4f}{flip}{lpips}"
