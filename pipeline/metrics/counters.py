"""Counters of the evaluate stage."""

from __future__ import annotations

from pydantic import Field

from pipeline.runtime.counters import StageCounters


class EvaluateCounters(StageCounters):
    """Counters of the evaluate stage: means over the measured views."""

    psnr: float = Field(description="Mean PSNR, dB.")
    ssim: float = Field(description="Mean SSIM; 1 for equal images.")
    flip: float = Field(description="Mean FLIP; 0 for equal images, at most 1.")
    lpips: float | None = Field(
        description="Mean LPIPS; 0 for equal images, null where it was not measured."
    )

    def headline(self) -> str:
        lpips = "" if self.lpips is None else f", LPIPS {self.lpips:.3f}"
        return f"PSNR {self.psnr:.2f} dB, SSIM {self.ssim:.4f}, FLIP {self.flip:.3f}{lpips}"
