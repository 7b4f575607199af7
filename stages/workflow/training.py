"""How the jobs of the stages that train run. Not in ``inputs``, which all stages import: their keys
would change with the code of training."""

from __future__ import annotations

from pipeline.config.schema import Train
from pipeline.render.registry import use_device
from pipeline.runtime.job import Job
from pipeline.training.scene import TrainingRun


def training_run(job: Job) -> TrainingRun:
    use_device(job.section(Train).device)
    return TrainingRun(
        seed=job.seed,
        threads=job.threads,
        memory_mb=job.memory_mb,
        checkpoint_dir=job.scratch / "checkpoints",
        logs=job.logs,
    )
