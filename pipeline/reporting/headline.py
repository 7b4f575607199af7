"""``python -m pipeline.reporting.headline results/<scene>``: print the result in one line."""

from __future__ import annotations

import sys
from pathlib import Path

from pipeline.reporting.metrics import Metrics, read_metrics, read_runs
from pipeline.runtime.errors import EXIT_USER_ERROR, UserError


def headline(metrics: Metrics) -> str:
    """One line: quality, number of Gaussians, poses, warnings."""
    perceptual = "".join(
        f", {name} {value:.3f}"
        for name, value in (("FLIP", metrics.flip), ("LPIPS", metrics.lpips))
        if value is not None
    )
    pose = metrics.pose_error
    known = pose is not None and pose.rotation_median_deg is not None
    error = f", rotation error {pose.rotation_median_deg:.3f} degrees" if pose and known else ""
    return (
        f"{metrics.scene}: PSNR {metrics.psnr:.2f} dB, SSIM {metrics.ssim:.4f}{perceptual}, "
        f"{metrics.num_gaussians} Gaussians, "
        f"{metrics.registered_images}/{metrics.total_images} images{error}, "
        f"{len(metrics.warnings)} warnings"
    )


def main(folders: list[str]) -> int:
    for name in folders:
        # results/<scene>, or a file in it.
        folder = Path(name) if Path(name).is_dir() else Path(name).parent
        try:
            metrics = read_metrics(folder)
            runs = read_runs(metrics, folder).values()
        except UserError as error:
            print(f"error: {error}", file=sys.stderr)
            return EXIT_USER_ERROR
        wall = sum(run.wall_s + run.earlier_s for run in runs)
        print(f"{headline(metrics)}, {wall:.0f} s\n  page: {folder / 'report.html'}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
