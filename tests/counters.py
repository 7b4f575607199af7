"""Counters of stages, for tests."""

from pipeline.photos.counters import InspectCounters
from pipeline.scene.georeference import GeoreferenceSummary
from pipeline.sfm.counters import AttemptRecord, CameraSummary, RefineCounters, SfmCounters
from pipeline.sfm.judge import Evidence
from pipeline.sfm.uncertainty_file import UncertaintySummary
from pipeline.training.loop.counters import ChangeCounters, TrainCounters

GOOD = Evidence(
    registered=20,
    total=20,
    reachable=20,
    points=4000,
    observations_per_image=800,
    mean_track_length=4.0,
    reprojection_px=0.5,
    explained_matches=0.9,
    agreeing_matches=0.99,
    agreeing_pairs=1.0,
    agreeing_distinctive=1.0,
    pairs_left_out=False,
    broken_steps=0,
    missing_covisibility=0.02,
    behind_camera=0.0,
    parallax=0.05,
    median_angle_deg=12.0,
    focal_off=1.05,
    focal_certainty=0.8,
    pincushion=1.0,
    focal_relative=0.9,
)
INSPECT = InspectCounters(photos=7, left_out=1)
SFM = SfmCounters(
    mapper="incremental",
    registered=6,
    total=7,
    not_registered=["g.jpg"],
    mean_reprojection_error_px=0.5,
    num_points=4000,
    mean_track_length=4.0,
    components=[],
    gaps=[],
    cameras=[
        CameraSummary(
            camera_id=1,
            model="SIMPLE_RADIAL",
            width=640,
            height=480,
            params=[600.0, 320.0, 240.0, 0.01],
            num_images=6,
            focal_prior_px=None,
            focal_uncertainty_percent=0.1,
        )
    ],
    uncertainty=UncertaintySummary(median=0.001, largest=0.002, direction_deg=0.01, uncertain=[]),
    verdict="good",
    evidence=GOOD,
    attempts=[
        AttemptRecord(
            mapper="incremental", change="", registered=6, verdict="good", reasons=[], taken=True
        )
    ],
    georeference=GeoreferenceSummary(method="level", origin=None, residuals_m=None),
)
REFINE = RefineCounters(freed=True, error_before_px=0.75, error_px=0.25)
TRAIN = TrainCounters(
    num_gaussians=1000,
    steps=300,
    known_depths=0,
    changes=ChangeCounters(cloned=0, split=500, relocated=0, pruned=20),
    opacity_resets=0,
    max_gaussians=1010,
    num_dropped=0,
    blind_steps=0,
    unseen=10,
    floaters=0,
)
