"""Check that all photographs and videos can be decoded, and read the given poses.

Outputs: ``images.json`` (the manifest); where the scene has them ``sparse/0`` (given poses) and
``unrounded.npz`` (the same, not rounded), ``truth`` and ``gcp_list.txt``;
``georeference.json`` if the given poses were translated or scaled; ``cloud.npz``, a subsample of
the scene's point cloud.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.config.schema import Config
from pipeline.photos.counters import InspectCounters
from pipeline.plan.colours import converted_colours
from pipeline.plan.stage import StageSpec
from pipeline.plan.values import Plan, StagePlan
from pipeline.plan.video_files import contents
from pipeline.runtime.atomic import write_bytes
from pipeline.runtime.job import Job
from pipeline.runtime.layout import SCAN_CACHE
from pipeline.runtime.section import read_section

if TYPE_CHECKING:
    from pipeline.plan.scan import Scan
    from pipeline.plan.settle import Settled


def decide(scan: Scan, settled: Settled) -> StagePlan:
    reason = contents(len(scan.photos), len(scan.videos))
    decisions = [scan.image_folder_reason, *converted_colours(scan.photos)]
    decisions += [scan.few_views] if scan.few_views else []
    return StagePlan(run=True, reason=reason, decisions=decisions)


def work(job: Job) -> None:
    from pipeline.io.clouds.stored import write_cloud
    from pipeline.io.colmap import read_model, write_model
    from pipeline.io.gcp import GCP_FILE
    from pipeline.photos.verify import verify_manifest
    from pipeline.plan.given_poses import load_given
    from pipeline.plan.point_cloud import read_point_cloud
    from pipeline.plan.scan import scan
    from pipeline.sfm.pose_check.check import check_poses

    config = read_section(Config, job.key["config"])
    folder = Path(job.key["folder"])
    found = scan(folder, folder.name, config, cache=job.out.parents[3] / SCAN_CACHE)
    found.check_unchanged(job.key["fingerprint"], folder)
    manifest, warnings = verify_manifest(
        found.manifest,
        threads=job.threads,
        min_photos=config.inspect.min_images,
        keep_duplicates=config.experiments.inspect.keep_duplicates or found.poses is not None,
    )
    job.add_messages([], [*found.warnings, *warnings])
    manifest.write(job.out / "images.json")
    count, given_counts, given = len(manifest.photos), {}, None
    videos = len(manifest.videos) if found.videos else None
    if (poses := found.poses) is not None:
        given = load_given(
            folder / poses.path, poses.kind, manifest.photos, found.listed, found.base_folder
        )
        if found.few_views:
            given = given.without_points()
        job.add_messages(given.write(job.out), [])
        if config.poses != "trust":
            check = check_poses(
                given.normalization.model_to_given(given.model),
                manifest.photos,
                poses.kind,
                folder / poses.path,
            )
            job.add_messages(check.decisions, check.warnings)
        model = given.model
        given_counts = {"given_poses": len(model.images), "given_points": len(model.points)}
    if found.cloud is not None:
        cloud = read_point_cloud(folder, found.cloud, found.poses, given)
        write_cloud(job.out, cloud)
        given_counts |= {"cloud_points": cloud.num_read}
        job.add_messages([f"{found.cloud.path}: {cloud.text}"], [])
    left_out = len(found.listed) - found.num_unused - count
    job.counters = InspectCounters(photos=count, left_out=left_out, videos=videos, **given_counts)
    if found.ground_control is not None and found.poses is None:
        write_bytes(job.out / GCP_FILE, found.ground_control.read_bytes())
    if found.truth is not None:
        write_model(job.out / "truth", read_model(found.truth))


def facts(plan: Plan) -> dict[str, Any]:
    scene = plan.facts
    return {"folder": plan.folder, "fingerprint": scene.fingerprint, "truth": scene.truth_digest}


SPEC = StageSpec(
    name="inspect",
    work=work,
    decide=decide,
    counters=InspectCounters,
    options=(
        *("poses", "inspect", "experiments.inspect", "views.masks", "split"),
        *("init.points_file", "sfm.georeference"),
    ),
    facts=facts,
)
