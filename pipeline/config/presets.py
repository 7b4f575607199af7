"""Starting values of the presets, over the defaults of the schema."""

from __future__ import annotations

from typing import Any

# balanced is the schema itself: minutes on two cores. fast is a first look; high is the papers'
# protocol (30 000 steps at full resolution, densification over the first half).
PRESETS: dict[str, dict[str, Any]] = {
    "fast": {
        "views": {"max_long_side_px": 640},
        "features": {"max_features": 3000, "max_long_side_px": 1200},
        "train": {"steps": 1500, "density": {"pixels_per_gaussian": 4.0}},
    },
    "balanced": {},
    "high": {
        "views": {"max_long_side_px": 1600},
        "features": {"max_features": 8192, "max_long_side_px": 2400},
        "train": {
            "steps": 30_000,
            "coarse_until": 0.2,
            "lr_final_share": 1.0,
            "lr_shN": 1.25e-4,
            "density": {"stop_share": 0.5, "recycle": 0.0},
        },
    },
}
