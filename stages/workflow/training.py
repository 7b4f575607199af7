"""How the jobs of the stages that train run. Not in ``inputs``, which all stages import: their keys
would change with the code of training."""

from __future__ import annotations

from pipeline.config.experiments import Experiments
from pipeline.config.settled import TrainOptions
from pipeline.render.registry import use_device
from pipeline.runtime.job import Job
from pipeline.training.run import WHOLE_RUN, Part, TrainingRun
from pipeline.training.scene import SceneData
from stages.workflow import inputs


def training_run(job: Job, part: Part = WHOLE_RUN) -> TrainingRun:
    """The run of a job that trains ``part`` of the schedule."""
    options = TrainOptions(**dict(inputs.drawing(job)), experiments=job.section(Experiments).train)
    use_device(options.device)
    return TrainingRun(
        options,
        checkpoint_dir=job.scratch / "checkpoints",
        logs=job.logs,
        seed=job.seed,
        threads=job.threads,
        memory_mb=job.memory_mb,
        part=part,
    )


def scene_data(job: Job) -> SceneData:
    """The scene of a job that trains it whole."""
    return SceneData(
        inputs.input_views(job), inputs.read_manifest(job, "views"), inputs.input_model(job)
    )
