"""``python -m pipeline.reporting.headline results/<scene>/metrics.json``: the result in a line."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any


def headline(metrics: dict[str, Any]) -> str:
    """One line for people: quality, size, poses, time."""
    lpips = "n/a" if metrics["lpips"] is None else f"{metrics['lpips']:.3f}"
    wall = sum(stage["wall_s"] for stage in metrics["stages"].values())
    pose = metrics["pose_error"]
    error = f", rotation error {pose['rotation_median_deg']:.3f} degrees" if pose else ""
    return (
        f"{metrics['scene']}: PSNR {metrics['psnr']:.2f} dB, SSIM {metrics['ssim']:.4f}, "
        f"LPIPS {lpips}, {metrics['num_gaussians']} Gaussians, "
        f"{metrics['registered_images']}/{metrics['total_images']} images{error}, "
        f"{wall:.0f} s, {len(metrics['warnings'])} warnings"
    )


if __name__ == "__main__":
    for name in sys.argv[1:]:
        print(headline(json.loads(Path(name).read_text())))
        print(f"  page: {Path(name).with_name('report.html')}")
