"""The cameras that stages after training see."""

from pipeline.runtime.job import Job
from pipeline.scene.colmap import has_model, read_model
from pipeline.scene.model import Reconstruction


def trained_model(job: Job) -> Reconstruction:
    """The views' model with its cameras where training left them (``train.refine_poses``,
    ``refine_intrinsics``)."""
    moved = job.inputs["train"] / "sparse" / "0"
    return read_model(moved if has_model(moved) else job.inputs["model"] / "sparse" / "0")
