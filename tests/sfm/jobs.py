"""Functions that tests run in separate processes: pycolmap is incompatible with torch (see
``pipeline.runtime.isolate``)."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

from pipeline.config import settled
from pipeline.config.experiments import MatchesExperiments
from pipeline.scene.manifest import Manifest
from pipeline.sfm.second_look import SecondLook


def digests(folder: Path) -> dict[str, str]:
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in files
    }


def flat(report: Any) -> dict[str, Any]:
    """A stage's report, its counters as in ``stage.json``."""
    values = vars(report).copy()
    return values.pop("counters").recorded() | values


def match(
    manifest: Manifest,
    features: Path,
    out: Path,
    pairs: str = "exhaustive",
    sfm: settled.Sfm | None = None,
    threads: int = 2,
    min_inliers: int = 15,
    look: SecondLook | None = None,
) -> dict[str, Any]:
    from pipeline.sfm.matching import MatchingScene, match_features

    experiments = MatchesExperiments(min_inliers=min_inliers)
    scene = MatchingScene(manifest, features, sfm or settled.Sfm(), 0, experiments)
    config = settled.Matches.model_validate({"pairs": pairs})
    report = match_features(
        *(scene, config, out / "database.db"),
        cache=out.with_name("cache"),
        threads=threads,
        look=look,
    )
    return flat(report)


def match_in_jobs(manifest: Manifest, features: Path, out: Path, count: int) -> dict[str, Any]:
    """As ``match``, by ``count`` jobs besides."""
    from pipeline.sfm.chunks import chunk
    from pipeline.sfm.matching import MatchingScene, choose_pairs, match_chunk, match_features

    config = settled.Matches(pairs="exhaustive")
    scene = MatchingScene(manifest, features, settled.Sfm(), 0)
    chosen = choose_pairs(scene, config)
    parts = [out.with_name(f"match_{number}.db") for number in range(1, count + 1)]
    cache = out.with_name("cache")
    pairs = cached = 0
    for number, part in enumerate(parts, start=1):
        scratch = out.with_name(f"scratch_{number}")
        own = chunk(chosen.pairs, number, count)
        report = match_chunk(scene, chosen, own, part, cache=cache, scratch=scratch, threads=2)
        pairs, cached = pairs + report.counters.num_pairs, cached + report.num_cached
    database = out / "database.db"
    whole = match_features(scene, config, database, cache=cache, chosen=chosen, parts=parts)
    assert whole.num_cached == pairs == whole.counters.num_pairs, "nothing is left to match"
    return flat(whole) | {"num_cached": cached}


def reconstruct(
    manifest: Manifest, database: Path, config: settled.Sfm, out: Path
) -> dict[str, Any]:
    from pipeline.sfm import mapping

    found = mapping.reconstruct(manifest, database, config, seed=0)
    found.write(out)
    return flat(found.report)


def match_and_reconstruct(
    manifest: Manifest, features: Path, out: Path, config: settled.Sfm, threads: int = 2
) -> tuple[dict[str, Any], dict[str, Any]]:
    matched = match(manifest, features, out / "matches", sfm=config, threads=threads)
    database = out / "matches" / "database.db"
    return matched, reconstruct(manifest, database, config, out / "sfm")


def planned_cameras(
    manifest: Manifest, sharings: list[str]
) -> dict[str, list[tuple[str, float, bool]]]:
    """``share_cameras`` -> (model, focal length, whether that is a prior) of each camera."""
    from pipeline.sfm.database import plan_cameras

    found = {}
    for sharing in sharings:
        cameras, _ = plan_cameras(manifest, settled.Sfm.model_validate({"share_cameras": sharing}))
        found[sharing] = [
            (c.model_name, float(c.mean_focal_length()), bool(c.has_prior_focal_length))
            for c in cameras
        ]
    return found


def returned(value: Any) -> Any:
    return value


def raise_user_error() -> None:
    from pipeline.runtime.errors import UserError

    raise UserError("is wrong", file="a.jpg", fix="repair it")


def raise_bug() -> None:
    raise KeyError("lost")


def die() -> None:
    import os
    import signal

    os.kill(os.getpid(), signal.SIGKILL)


def sleep_long(started: Path) -> None:
    import os
    import time

    started.write_text(str(os.getpid()))
    time.sleep(600)


def wait_for_sleeper(started: Path) -> None:
    from pipeline.runtime.isolate import run_isolated

    run_isolated(sleep_long, started)


def sleep(seconds: float) -> None:
    import time

    time.sleep(seconds)


def allocate(size: int) -> int:
    return len(bytearray(size))


def connects(port: int) -> bool:
    """Whether a server on this machine can be reached."""
    import socket

    try:
        socket.create_connection(("127.0.0.1", port), timeout=5).close()
    except OSError:
        return False
    return True


def may_have_no_network() -> bool:
    """Whether the kernel allows this process to enter a network namespace of its own."""
    import ctypes

    unshare = ctypes.CDLL(None).unshare
    return unshare(0x40000000) == 0 or unshare(0x50000000) == 0
