"""What each stage reads, and the key that says when it must run again.

The Snakefile binds stages to one another from these tables and nothing else.
"""

from __future__ import annotations

from functools import cache
from importlib.metadata import version
from typing import Any

from pipeline.config.schema import Config
from pipeline.metrics.lpips import weights_found
from pipeline.runtime.job import canonical
from pipeline.runtime.source import stage_source_hash
from pipeline.scene.plan import Plan

_PHOTOS = ("decode", "inspect")
_VIEWS = ("undistort", "decode", "inspect")
_GIVEN = ("decode", "inspect")
_POSES = ("sfm", "refine", *_GIVEN)
_MODEL = ("undistort", *_POSES)

# stage -> role -> stages that can fill it; the first one that the plan runs does.
ROLES: dict[str, dict[str, tuple[str, ...]]] = {
    "inspect": {},
    "decode": {"photos": ("inspect",)},
    "features": {"photos": _PHOTOS},
    "matches": {"photos": _PHOTOS, "features": ("features",)},
    "sfm": {"photos": _PHOTOS, "matches": ("matches",), "inspect": ("inspect",)},
    "refine": {"model": _GIVEN},
    "undistort": {"photos": _PHOTOS, "model": _POSES},
    "init": {"views": _VIEWS, "model": _MODEL},
    "train": {"views": _VIEWS, "model": _MODEL, "init": ("init",)},
    "evaluate": {
        "views": _VIEWS,
        "model": _MODEL,
        "train": ("train",),
        "poses": _POSES,
        "inspect": ("inspect",),
    },
    "export": {"views": _VIEWS, "model": _MODEL, "train": ("train",), "poses": _POSES},
    "report": {
        "views": _VIEWS,
        "model": _MODEL,
        "inspect": ("inspect",),
        "poses": _POSES,
        "train": ("train",),
        "evaluate": ("evaluate",),
        "export": ("export",),
    },
}

# stage -> config sections it reads.
SECTIONS: dict[str, tuple[str, ...]] = {
    "inspect": ("inspect", "views"),
    "decode": ("decode",),
    "features": ("features",),
    "matches": ("matches", "sfm"),
    "sfm": ("sfm",),
    "refine": ("sfm",),
    "undistort": ("undistort", "views"),
    "init": ("init", "views", "split", "features", "matches"),
    "train": ("train", "views", "split"),
    "evaluate": ("evaluate", "views", "split", "train"),
    "export": ("export", "views", "split", "train"),
    "report": ("report", "views", "split", "train"),
}

# stage -> packages whose version decides its result.
PACKAGES: dict[str, tuple[str, ...]] = {
    "decode": ("rawpy",),
    "features": ("opencv-contrib-python-headless", "pycolmap"),
    "matches": ("pycolmap",),
    "sfm": ("pycolmap", "numpy", "scipy"),
    "refine": ("pycolmap", "numpy", "scipy"),
    "undistort": ("opencv-contrib-python-headless",),
    "init": ("pycolmap", "scipy", "opencv-contrib-python-headless"),
    "train": ("torch", "numpy", "opencv-contrib-python-headless"),
    "evaluate": ("torch", "numpy", "scipy", "opencv-contrib-python-headless"),
    "export": ("torch", "numpy", "scipy", "scikit-image", "opencv-contrib-python-headless"),
}


# Stages that draw random numbers, and the one that shows the seed. The others have no seed in their
# keys, so that runs with other seeds share their work.
SEEDED = ("matches", "sfm", "init", "train", "report")

# Asked again for every run of a batch.
_version = cache(version)
_source_hash = cache(stage_source_hash)


def upstream(stage: str, plan: Plan) -> dict[str, str]:
    """Role -> the stage that fills it, for a scene with this plan."""
    return {
        role: next(name for name in candidates if plan.runs(name))
        for role, candidates in ROLES[stage].items()
    }


def stage_key(stage: str, plan: Plan, folder: str, fingerprint: str) -> str:
    """The stage's key: one canonical JSON string.

    Snakemake compares parameters as a set of ``repr(value)``, so only a single canonical string
    notices every change. It holds the config sections the stage reads (settled by the plan), the
    hash of its source, the versions of the packages that decide its result, the seed where it
    matters, for the first stage the scene's folder and fingerprint, for evaluation the true poses
    and the LPIPS weights at hand, for the last the plan it shows. What changes only the speed is
    not in it.
    """
    config: Config = plan.config
    dumped = config.model_dump(mode="json")
    key: dict[str, Any] = {
        "stage": stage,
        "seed": config.seed if stage in SEEDED else None,
        "source": _source_hash(f"stages.{stage}"),
        "packages": {name: _version(name) for name in PACKAGES.get(stage, ())},
        "config": {name: dumped[name] for name in SECTIONS[stage]},
    }
    if stage == "inspect":
        key |= {"folder": folder, "fingerprint": fingerprint, "poses": config.poses}
        key["truth"] = plan.facts["truth_digest"]
    if stage == "evaluate":
        key["lpips_weights"] = weights_found(config.evaluate.lpips_net)
        key["truth"] = plan.facts["truth_digest"]
    if stage == "report":
        key["plan"] = public_plan(plan)
    return canonical(key)


def public_plan(plan: Plan) -> dict[str, Any]:
    """What ``plan.json`` holds: every stage with run or skip, the reasons, what feeds it, facts,
    warnings."""
    shown = plan.model_dump(mode="json", exclude={"config"})
    for name, step in shown["stages"].items():
        step["inputs"] = sorted(set(upstream(name, plan).values())) if step["run"] else []
    return shown
