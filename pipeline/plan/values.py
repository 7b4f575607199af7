"""The values of a plan. ``pipeline.plan.plan`` makes it from the declarations of the stages."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field

from pipeline.config.settled import Config
from pipeline.io.posefiles import PoseSummary
from pipeline.plan.point_cloud import PointCloudFiles


class StagePlan(BaseModel):
    """Whether a stage runs for a scene, the reason, and decisions about its options."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    run: bool = Field(description="Whether the scene needs the stage.")
    reason: str = Field(description="Why it runs, or why not.")
    decisions: list[str] = Field([], description="Values of its options, with the reasons.")
    inputs: list[str] = Field([], description="The stages whose output it reads.")
    jobs: int = Field(1, description="Number of its jobs, which share its work.")

    def folders(self, stage: str) -> list[str]:
        """The names of the stage's folders in ``results/<scene>/``: its own, with the number of the
        job if it has several."""
        return job_folders(stage, self.jobs)


def job_folders(stage: str, jobs: int) -> list[str]:
    """The folders of a stage with ``jobs`` jobs (see ``StagePlan.folders``)."""
    return [stage] if jobs == 1 else [f"{stage}_{job}" for job in range(1, jobs + 1)]


class SceneFacts(BaseModel):
    """Counts and properties of a scene's files."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    photographs: int = Field(description="Number of photographs that can be read.")
    videos: int = Field(0, description="Number of videos that can be read.")
    max_frames: int = Field(
        0,
        description="Number of frames that are chosen of them at most; counted in `bits`, `sizes`, "
        "`camera_groups` and `training_memory_mb`.",
    )
    video_frames: int = Field(
        0, description="Number of frames of the videos according to their headers; 0 if unknown."
    )
    linear: int = Field(description="Number of RAW and EXR files among the photographs.")
    panoramas: int = Field(0, description="Number of equirectangular panoramas among them.")
    alpha: int = Field(description="Number of photographs with transparent pixels.")
    masks: int = Field(description="Number of photographs with a mask.")
    depths: int = Field(description="Number of photographs with a depth map.")
    gps: int = Field(description="Number of photographs with a GPS position.")
    ground_control: bool = Field(description="Whether the scene has a `gcp_list.txt`.")
    point_cloud: PointCloudFiles | None = Field(
        None,
        description="The point cloud that the Gaussians are initialised from; null without one.",
    )
    gps_extent_m: float = Field(
        description="Diagonal of the GPS positions' bounding box, metres; 0 without positions."
    )
    focal_priors: int = Field(description="Number of photographs with a focal length from EXIF.")
    turned_by_exif: int = Field(
        description="Number of photographs with an EXIF orientation other than 1."
    )
    bits: int = Field(description="Largest number of bits per channel.")
    sizes: dict[str, int] = Field(
        description="Size of photographs, `<width>x<height>` in pixels, to their number; the most "
        "frequent sizes, `others` counts the rest."
    )
    camera_groups: dict[str, int] = Field(
        description="Camera body, lens, focal length and size to the number of photographs; the "
        "most frequent groups, `others` counts the rest."
    )
    ordered: str | None = Field(
        description="Why the photographs are treated as a sequence; null where they are not."
    )
    image_folder: str = Field(description="Folder of the photographs, relative to the scene's.")
    view_size: tuple[int, int] = Field(
        description="Width and height of the training views of the most frequent size, pixels."
    )
    training_memory_mb: int = Field(description="Estimate of the memory of training, MB.")
    given_poses: PoseSummary | None = Field(description="null where no poses are given or used.")
    published_scene: str | None = Field(
        None,
        description="Scene of a published benchmark that the folder is, by its name, its "
        "photographs and `split.train_views`; null for others.",
    )
    truth: str | None = Field(description="Folder of ground truth poses; null without any.")
    truth_digest: str | None = Field(description="Digest of the ground truth poses.")
    fingerprint: str = Field(
        description="Digest of the names and contents of photographs, videos, masks, depth maps, "
        "pose files, ground control points and point cloud."
    )


class Plan(BaseModel):
    """The plan of a scene.

    Attributes:
        scene: The name of the scene or run.
        stages: The plan of each stage by its name, in the order of the DAG.
        config: The settled options.
        facts: The facts about the scene that the plan depends on.
        folder: The scene folder, relative to the working directory or absolute.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    scene: str
    stages: dict[str, StagePlan]
    warnings: list[str]
    config: Config
    facts: SceneFacts
    folder: str = ""

    @property
    def photos_per_job(self) -> int:
        """The number of photographs of a job of feature extraction."""
        count = self.facts.photographs + self.facts.max_frames
        wanted = self.config.features.photos_per_job
        return count if wanted == "auto" else min(wanted, count)

    @property
    def is_one_job(self) -> bool:
        """Whether features and matches are computed in one job each."""
        return self.photos_per_job == self.facts.photographs + self.facts.max_frames

    def runs(self, stage: str) -> bool:
        return self.stages[stage].run
