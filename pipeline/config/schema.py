"""Every option, one section a stage. The docs and ``config/default.yaml`` are made from here.

A field whose value is "auto" (or null) is settled by the plan from what the scene shows.
Importing this module costs pydantic and nothing heavier: the Snakefile imports it.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

Positive = Annotated[int, Field(gt=0)]
Share = Annotated[float, Field(ge=0.0, le=1.0)]
Rate = Annotated[float, Field(ge=0.0)]


class Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Inspect(Section):
    """Looking at the folder once."""

    image_folder: str = Field(
        "auto",
        description="Folder of photographs inside the scene folder; auto takes images/, else the "
        "scene folder itself or its only subfolder with photographs. Of images/ and "
        "images_2|4|8/ auto takes the smallest not below views.max_long_side_px (where poses "
        "are to be found, nor below features.max_long_side_px).",
    )
    min_images: Positive = Field(2, description="Fewer readable photographs than this is an error.")


class Views(Section):
    """The pictures that training and evaluation see: resolution and masks."""

    max_long_side_px: Positive = Field(
        800, description="Views with a longer side are resized (by area) down to this, in pixels."
    )
    masks: Literal["auto", "ignore"] = Field(
        "auto", description="auto uses masks/ where it exists: zero pixels count for nothing."
    )


def _not_all(every: int) -> int:
    if every == 1:
        raise ValueError("Input should be 0 or at least 2: 1 leaves no view to train on")
    return every


class Split(Section):
    """Which views training never sees."""

    holdout_every: Annotated[int, Field(ge=0), AfterValidator(_not_all)] = Field(
        8,
        description="Every n-th view, sorted by name, is held out of training and used only to "
        "evaluate; 0 trains on all and evaluates on the training views (said in the protocol).",
    )


class Decode(Section):
    """RAW to pictures, all views of a scene developed alike."""

    demosaic: Literal["linear", "ahd", "aahd"] = Field("ahd", description="LibRaw's demosaicker.")
    half_size: bool = Field(False, description="Half the width and height, four times as fast.")
    linear: bool = Field(
        False, description="16-bit linear light instead of display-ready 8-bit sRGB."
    )
    white_balance: Literal["camera", "daylight"] = Field(
        "camera",
        description="camera: the median of the photographs' as-shot balance, for all of them; "
        "daylight: the sensor's daylight balance.",
    )


class Features(Section):
    """SIFT keypoints."""

    backend: Literal["opencv", "colmap"] = Field(
        "opencv", description="opencv (faster, RootSIFT) or COLMAP's own extractor."
    )
    max_features: Positive = Field(4096, description="Strongest features kept for an image.")
    max_long_side_px: Positive = Field(
        1600, description="Larger photographs are reduced to this for feature extraction, pixels."
    )


class Matches(Section):
    """Which pairs are matched, and how they are verified."""

    pairs: Literal["auto", "exhaustive", "sequential", "spatial", "retrieval"] = Field(
        "auto",
        description="auto: exhaustive up to 40 photographs; above, spatial where GPS tells them "
        "apart, sequential where times or names say they are one walk, else retrieval.",
    )
    neighbours: Positive = Field(
        16, description="Pairs an image (sequential overlap, spatial or retrieval neighbours)."
    )
    max_ratio: Share = Field(0.8, description="Lowe's ratio test.")
    min_inliers: Positive = Field(15, description="Fewer verified matches drop a pair.")


class Sfm(Section):
    """Camera poses and sparse points."""

    mapper: Literal["auto", "incremental", "global"] = Field(
        "auto", description="auto: incremental, and global where that gives no good model."
    )
    camera_model: Literal[
        "auto", "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE"
    ] = Field(
        "auto", description="auto: SIMPLE_RADIAL; OPENCV_FISHEYE where EXIF names a fisheye lens."
    )
    share_cameras: Literal["auto", "single", "group", "image"] = Field(
        "auto",
        description="group: one camera for photographs of one body, lens, focal and size; "
        "single: one for all; image: one each; auto: group, but image for a collection by many "
        "cameras.",
    )
    refine_radial: Literal["auto", "no"] = Field(
        "auto",
        description="auto: a last bundle adjustment turns SIMPLE_RADIAL cameras into RADIAL ones "
        "where that lowers the error.",
    )
    refine_principal_point: Literal["auto", "yes", "no"] = Field(
        "auto",
        description="auto: in a last bundle adjustment, kept where the geometry carries it; of "
        "given poses, where it stands exactly in the middle.",
    )
    min_registered_share: Share = Field(
        0.5, description="A model with fewer of the photographs registered is a failure."
    )
    max_attempts: Positive = Field(
        4,
        description="While the model is not good, map again at most so many times in all: by the "
        "other mapper, with one camera a size, with other focal lengths, as a fisheye.",
    )
    georeference: Literal["auto", "gps", "gcp", "none"] = Field(
        "auto",
        description="The model's frame. gcp: metres in the projection of gcp_list.txt "
        "(OpenDroneMap's ground control points); gps: metres east, north and up of the EXIF "
        "positions; none: level, y down, of unit size; auto: the first that there is. Origin and "
        "residuals are in sfm/georeference.json.",
    )


class Undistort(Section):
    """Pictures and masks as pinhole cameras would have seen them."""

    blank_pixels: Share = Field(
        0.0, description="Share of blank border allowed: 0 crops to valid pixels, 1 keeps all."
    )
    jpeg_quality: Annotated[int, Field(ge=0, le=100)] = Field(
        0, description="0 writes lossless PNG; otherwise JPEG of this quality."
    )


class Init(Section):
    """The first Gaussians."""

    method: Literal["auto", "points", "random"] = Field(
        "auto", description="auto: sparse points, triangulated if the poses came without any."
    )
    num_random: Positive = Field(10_000, description="Gaussians of a random start.")
    opacity: Share = Field(
        0.3, description="Opacity of a new Gaussian; of a random start 0.1 at most."
    )
    max_points: Positive = Field(
        200_000,
        description="More sparse points are thinned to this, or to "
        "half of the budget of Gaussians, so that room is left to densify.",
    )


class Density(Section):
    """Density control: which Gaussians there are."""

    strategy: Literal["gradient", "mcmc"] = Field(
        "gradient",
        description="gradient: split, clone and prune (Kerbl et al. 2023, section 5.2); mcmc: "
        "relocate, grow and shake (Kheradmand et al. 2024).",
    )
    start_step: int = Field(500, description="First densification.")
    stop_share: Share = Field(0.7, description="Densify until this share of the steps.")
    interval: Positive = Field(100, description="Steps between densifications.")
    grad_threshold: Rate = Field(
        1e-5,
        description="Gaussians with a larger mean view-space positional gradient (in NDC) are "
        "split, the largest first, as far as the budget allows (3DGS: 2e-4).",
    )
    absolute_gradient: bool = Field(
        False,
        description="Sum the absolute values of each pixel's gradient (AbsGS), so that pulls in "
        "opposite directions don't cancel; wants a larger grad_threshold.",
    )
    clone: bool = Field(
        False, description="gradient: the small are cloned (3DGS); without, they split, too."
    )
    split: bool = Field(True, description="gradient: without, all are cloned.")
    split_kind: Literal["long_axis", "sampled"] = Field(
        "long_axis",
        description="How one becomes two: long_axis: side by side along its longest axis (after "
        "Deng et al. 2025); sampled: at random places in it, each 1.6 times as small (3DGS), as "
        "spheres (`isotropic`) always do.",
    )
    split_scale: Rate = Field(
        0.01,
        description="With `clone`: Gaussians larger than this share of the scene's size split.",
    )
    clear_air: bool = Field(
        True,
        description="Now and then Gaussians are removed that hang before one camera or very few: "
        "one view, or a hundredth of them, has most of their weight, and the nearest sparse points "
        "it sees are more than twice as far. Only in runs of 50 looks and more at each photograph.",
    )
    recycle: Share = Field(
        0.02,
        description="gradient: where the budget is used up, up to this share of it is taken each "
        "time, for the Gaussians most wanted, from the faintest of those that nothing pulls at.",
    )
    prune_opacity: Share = Field(0.005, description="Fainter Gaussians are removed.")
    prune_scale: Rate = Field(
        0.1,
        description="Larger ones (share of the scene's size) are removed after the first opacity "
        "reset.",
    )
    opacity_reset_interval: Positive = Field(
        3000,
        description="Steps between opacity resets; there is one only where as many steps of "
        "density control still follow, so that short runs have none.",
    )
    growth: Rate = Field(0.05, description="mcmc: the set grows by this share each time.")
    noise: bool = Field(True, description="mcmc: faint Gaussians move at random.")
    opacity_cost: Rate = Field(0.01, description="mcmc: weight of the mean opacity in the loss.")
    scale_cost: Rate = Field(0.01, description="mcmc: weight of the mean scale in the loss.")
    pixels_per_gaussian: Literal["auto"] | Annotated[float, Field(gt=0)] = Field(
        "auto",
        description="Budget: a view's pixels over this, or fewer where there are few photographs "
        "or `budget_minutes`. auto: 2, or 0.5 with `budget_minutes`, which limit the budget, too.",
    )
    max_gaussians: Positive = Field(
        1_000_000, description="Budget: never more Gaussians than this, whatever the pixels."
    )


class Train(Section):
    """The optimisation of the Gaussians."""

    steps: Positive = Field(
        4000,
        description="Optimiser steps, one view each. Below 7000, the intervals that are counted in "
        "steps shrink in proportion.",
    )
    budget_minutes: Annotated[float, Field(gt=0)] | None = Field(
        None,
        description="Instead of steps: train for so many minutes by the clock, as well as that "
        "allows. How many steps fit depends on the machine and its load, so two runs differ.",
    )
    memory_mb: Positive | None = Field(
        None,
        description="Most memory that training may take, in MB: no more Gaussians are trained than "
        "fit, and pictures that do not fit beside them are read from disk as they are needed. "
        "Without it they are where training would take over three quarters of the memory that the "
        "machine, or its container, has; that changes no result.",
        json_schema_extra={"decides_result": False},
    )
    sh_degree: Annotated[int, Field(ge=0, le=3)] = Field(3, description="Spherical harmonics.")
    sh_interval: Positive = Field(1000, description="Steps between one SH degree and the next.")
    ssim_weight: Share = Field(
        0.3, description="Weight of D-SSIM (3DGS: 0.2); the pixels' errors have the rest."
    )
    square_weight: Rate = Field(
        2.5,
        description="Weight of the squared error beside L1's 1, so that what is far off counts for "
        "more, as it does in PSNR (3DGS: 0).",
    )
    coarse_until: Literal["auto"] | Annotated[float, Field(ge=0, lt=1)] = Field(
        "auto",
        description="Share of the steps, or of `budget_minutes`, trained at reduced resolution "
        "(1/4, then 1/2). auto: 0.15 of the steps; 0.1 of `budget_minutes`, at most 1.2 minutes.",
    )
    background: Literal["auto", "black", "white", "random"] = Field(
        "auto", description="auto: white where images have alpha, else black."
    )
    alpha_weight: Rate = Field(
        0.15,
        description="Weight of the error of what the render covers (its alpha) where images have "
        "alpha, beside L1's 1, so that nothing hides against `background` (3DGS: 0).",
    )
    exposure: Literal["auto", "on", "off"] = Field(
        "auto",
        description="on: each photograph's brightness and white balance, measured at the sparse "
        "points, are laid over the render before it is compared; auto: where they differ between "
        "photographs by over 0.2 stops (standard deviation).",
    )
    depth_weight: Rate | Literal["auto"] = Field(
        "auto",
        description="Weight of the depths of the sparse points in the views that see them, and of "
        "depth maps in depths/ (mean error of the logarithm); 0: colours alone; auto: 0.3 with "
        "depth maps, 0.03 for up to 30 photographs, else 0.",
    )
    masked_opacity: Rate = Field(
        0.1,
        description="How strongly what is drawn where a mask hides the photograph is made to "
        "vanish, beside the error of other pixels; 0: nothing is asked of masked pixels.",
    )
    refine_poses: bool = Field(
        False,
        description="Move the cameras with the Gaussians, where given poses are off by a little. "
        "Held-out cameras are fitted to their photographs before they are measured on, and the "
        "protocol says so.",
    )
    pose_reach: Annotated[float, Field(gt=0, lt=1)] = Field(
        0.02,
        description="With `refine_poses`: how far a camera can go in all, in radians and in the "
        "scene's extents. More than poses are off by.",
    )
    refine_intrinsics: bool = Field(
        False,
        description="Adjust each camera's focal length and principal point with the Gaussians, "
        "where given ones are off by a little. Views of one camera share them.",
    )
    intrinsics_reach: Annotated[float, Field(gt=0, lt=1)] = Field(
        0.02,
        description="With `refine_intrinsics`: how far they can go in all, in shares of the focal "
        "length. More than they are off by.",
    )
    salt_and_pepper: Share = Field(
        0.0,
        description="An experiment: this share of the training pixels is black or white at random. "
        "Held-out views stay as they are.",
    )
    black_stays: bool = Field(
        False,
        description="A colour clamped at 0 learns nothing, as in 3DGS; otherwise it may come back.",
    )
    gradients_per_pixel: Annotated[int, Field(ge=0)] = Field(
        0,
        description="An experiment: a pixel's gradients go only to so many Gaussians, the first "
        "that it draws; 0: to all.",
    )
    isotropic: bool = Field(False, description="Spheres instead of ellipsoids.")
    antialias: bool = Field(
        False,
        description="Mip-Splatting's opacity compensation: truer where Gaussians are smaller than "
        "pixels, but only viewers that compensate, too, draw such a scene as it was trained.",
    )
    adam_beta1: Annotated[float, Field(ge=0, lt=1)] = Field(
        0.8, description="How much of the steps before goes on in each (3DGS: 0.9)."
    )
    lr_means_unit: Literal["size", "scene"] = Field(
        "size",
        description="What the means' rate is times: size: along each of a Gaussian's own axes its "
        "scale there, and it is turned about these axes; scene: how far apart the cameras stand, "
        "but at most half of the median depth of the sparse points they see (3DGS: how far apart "
        "alone, 1.6e-4 and 1.6e-6).",
    )
    lr_means: Rate = Field(0.04, description="At the start.")
    lr_means_final: Annotated[float, Field(gt=0)] = Field(
        4e-3, description="At the end (log-linear decay)."
    )
    lr_boost: Annotated[float, Field(gt=0)] | Literal["auto"] = Field(
        "auto",
        description="All rates are multiplied by this; auto: by sqrt(30000 / steps), at most "
        "4, in runs shorter than the papers' 30 000 steps.",
    )
    lr_decay_from: Annotated[float, Field(ge=0, lt=1)] = Field(
        0.7, description="From this share of the run on, the rates below fall (log-linearly)"
    )
    lr_final_share: Annotated[float, Field(gt=0, le=1)] = Field(
        0.1, description="to this share of themselves."
    )
    lr_scales: Rate = 5e-3
    lr_quats: Rate = Field(2e-3, description="Half the angle of a turn, in radians (3DGS: 1e-3).")
    lr_opacities: Rate = Field(2.5e-2, description="3DGS: 5e-2.")
    lr_sh0: Rate = 2.5e-3
    lr_shN: Rate = Field(6e-4, description="Higher SH bands (3DGS: 1.25e-4).")
    density: Density = Field(default_factory=Density)


class Evaluate(Section):
    """Held-out views against renders."""

    lpips_net: Literal["vgg", "alex", "none"] = Field(
        "vgg", description="LPIPS backbone; its weights are looked for, never downloaded."
    )


ExportFormat = Literal[
    "ply",
    "spz",
    "splat",
    "gltf",
    "points",
    "colmap",
    "colmap_text",
    "transforms",
    "renders",
    "depths",
    "mesh",
    "video",
]


class Export(Section):
    """Files for other programs."""

    formats: tuple[ExportFormat, ...] = Field(
        ("ply", "spz", "points", "colmap", "transforms"),
        description="The Gaussians: ply (INRIA's layout, exact), spz (a sixth of the size), splat "
        "(without SH), gltf (.glb, KHR_gaussian_splatting). points: coloured sparse cloud. "
        "The cameras: colmap (with the points), colmap_text (likewise), transforms "
        "(nerfstudio's transforms.json). Drawn from every view, and off unless asked for: renders "
        "(PNG), depths (float TIFF), mesh (PLY and GLB), video (along a camera path).",
    )
    sh_degree: Annotated[int, Field(ge=0, le=3)] = Field(3, description="Truncate SH to this.")
    min_opacity: Share = Field(0.0, description="Leave fainter Gaussians out.")
    morton_order: bool = Field(
        True,
        description="Sort Gaussians along a Z-order curve, so that neighbours in space are "
        "neighbours in the file (smaller, faster to show); otherwise they keep training's order.",
    )
    mesh_voxel: Annotated[float, Field(gt=0)] | None = Field(
        None,
        description="Side of the mesh's voxels in the scene's unit; null takes 2.5 pixels at the "
        "median depth. Larger where 24 million voxels would not do.",
    )


class Report(Section):
    """The page."""

    views: Positive = Field(3, description="Views shown beside photographs, worst to best.")


class Config(Section):
    """All options of a scene."""

    preset: Literal["fast", "balanced", "high"] = Field(
        "balanced", description="Starting values; single options override it."
    )
    poses: Literal["auto", "keep", "ignore"] = Field(
        "auto",
        description="Poses that the scene brings. auto: used, and adjusted to their own tracks "
        "where the principal points were only assumed; keep: used as they are; ignore: poses are "
        "reconstructed all the same.",
    )
    seed: Annotated[int, Field(ge=0, lt=2**31)] = 0
    inspect: Inspect = Field(default_factory=Inspect)
    views: Views = Field(default_factory=Views)
    split: Split = Field(default_factory=Split)
    decode: Decode = Field(default_factory=Decode)
    features: Features = Field(default_factory=Features)
    matches: Matches = Field(default_factory=Matches)
    sfm: Sfm = Field(default_factory=Sfm)
    undistort: Undistort = Field(default_factory=Undistort)
    init: Init = Field(default_factory=Init)
    train: Train = Field(default_factory=Train)
    evaluate: Evaluate = Field(default_factory=Evaluate)
    export: Export = Field(default_factory=Export)
    report: Report = Field(default_factory=Report)
