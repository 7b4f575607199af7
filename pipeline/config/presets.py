"""Starting values of the presets, over the defaults of the schema."""

from __future__ import annotations

from typing import Any

# balanced is the schema itself. fast aims at a look within minutes on two cores; high at the
# papers' 30 000 steps.
PRESETS: dict[str, dict[str, Any]] = {
    "fast": {
        "views": {"max_long_side_px": 640},
        "features": {"max_features": 3000, "max_long_side_px": 1200},
        "train": {"steps": 2000, "density": {"max_gaussians": 100_000}},
    },
    "balanced": {},
    "high": {
        "views": {"max_long_side_px": 1600},
        "features": {"max_features": 8192, "max_long_side_px": 2400},
        "train": {"steps": 30_000, "density": {"max_gaussians": 1_000_000}},
    },
}
