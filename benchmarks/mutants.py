"""Mutation tests: deliberate faults, one at a time, each of which a test must detect.

    python -m benchmarks.mutants            # all: some twenty minutes on two cores
    python -m benchmarks.mutants sh_sign    # selected ones

Each fault is inserted into a copy of the project, whose tests then run up to the first failure.
Before, the same tests must pass without a fault. The exit code is 1 if a fault survives.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
COPIED = ("pipeline", "stages", "benchmarks", "tests", "config", "profiles", "docs")
SECONDS = 1800


@dataclass(frozen=True)
class Mutant:
    """One fault.

    Attributes:
        file: The path of the file, relative to the project.
        old: The text to replace, which occurs exactly once.
        new: The replacement.
        what: The description of the fault.
        tests: Files or folders of tests, of which at least one must fail.
    """

    file: str
    old: str
    new: str
    what: str
    tests: tuple[str, ...]


_CSRC = "pipeline/render/cpu/csrc"
_KERNELS = ("tests/render/test_kernels.py",)
_LOSS = ("tests/render/test_loss_adam.py",)

MUTANTS: dict[str, Mutant] = {
    "accepts_missing": Mutant(
        "pipeline/reporting/acceptance/judge.py",
        'f"not measured ({check.missing})", False',
        'f"not measured ({check.missing})", True',
        "a rule is met by a figure that was not measured",
        ("tests/reporting/acceptance",),
    ),
    "prunes_most": Mutant(
        "pipeline/export/selection.py",
        "np.argsort(-weights,",
        "np.argsort(weights,",
        "the Gaussians that show least are kept",
        ("tests/export",),
    ),
    "other_split": Mutant(
        "pipeline/reporting/acceptance/measured.py",
        "if theirs != ours:",
        "if False:",
        "a baseline of another split or resolution is compared",
        ("tests/reporting/acceptance",),
    ),
    "half_gradient": Mutant(
        f"{_CSRC}/project_math.h",
        "d_cam.x * row(view.rotation, 0) + d_cam.y",
        "0.5 * d_cam.x * row(view.rotation, 0) + d_cam.y",
        "a share of the means' gradient halved",
        _KERNELS,
    ),
    "pixel_centre": Mutant(
        f"{_CSRC}/project_math.h",
        "p.x = view.fx * u + view.cx;",
        "p.x = view.fx * u + view.cx - 0.5;",
        "pixel centres at whole numbers",
        _KERNELS,
    ),
    "sh_sign": Mutant(
        f"{_CSRC}/sh.h",
        "term(3, -a1 * x, splat16(-a1), o, o);",
        "term(3, a1 * x, splat16(a1), o, o);",
        "the sign of a spherical harmonic, in value and derivative alike",
        _KERNELS,
    ),
    "behind": Mutant(
        f"{_CSRC}/blend_backward.cpp",
        "s.weight * e - odds * t.behind",
        "s.weight * e + odds * t.behind",
        "what lies behind a Gaussian counted with the wrong sign",
        _KERNELS,
    ),
    "black_for_good": Mutant(
        f"{_CSRC}/project_backward.cpp",
        "view.clamp_color_gradient ? zero : min(d, zero)",
        "zero",
        "a colour that fell to zero never comes back",
        _KERNELS,
    ),
    "ssim_constant": Mutant(
        f"{_CSRC}/loss.cpp",
        "kC1 = 1e-4f, kC2 = 9e-4f",
        "kC1 = 1e-4f, kC2 = 3e-4f",
        "another constant in SSIM",
        _LOSS,
    ),
    "loss_scale": Mutant(
        f"{_CSRC}/loss.cpp",
        "error_scale_(float((1 - weights.ssim) / double(count))),",
        "error_scale_(float(0.5 * (1 - weights.ssim) / double(count))),",
        "the gradient of the plain error halved",
        _LOSS,
    ),
    "adam_bias": Mutant(
        f"{_CSRC}/adam.h",
        "std::pow(beta2, double(step))",
        "std::pow(beta2, double(step + 1))",
        "Adam's bias correction one step late",
        _LOSS,
    ),
    "unit_lost": Mutant(
        f"{_CSRC}/adam.cpp",
        "along[k] *= mean_rate * scale[k];",
        "along[k] *= mean_rate;",
        "a mean's step in the world's unit instead of its Gaussian's scales",
        _LOSS,
    ),
    "world_turns": Mutant(
        f"{_CSRC}/adam.cpp",
        "{{-x, w, z, -y}, {-y, -z, w, x}, {-z, y, -x, w}}",
        "{{-x, w, -z, y}, {-y, z, w, -x}, {-z, -y, x, w}}",
        "quaternions turned about the world's axes instead of their own",
        _LOSS,
    ),
    "no_drift": Mutant(
        f"{_CSRC}/sh_adam.h",
        "if (missed) p -= rate * m * load<f32x16>(before + 16 * j);",
        "",
        "what Adam would have done out of view never made good",
        _LOSS,
    ),
    "moments_truncated": Mutant(
        f"{_CSRC}/bfloat16.h",
        "(bits + 0x7fffu + (bits >> 16 & 1u)) >> 16",
        "bits >> 16",
        "first moments of SH are rounded towards zero",
        _LOSS,
    ),
    "short_reach": Mutant(
        f"{_CSRC}/project.cpp",
        "kMostReach = 3.34",
        "kMostReach = 2.0",
        "the bound for Gaussians out of view too small",
        _KERNELS,
    ),
    "camera_turn": Mutant(
        f"{_CSRC}/project_math.h",
        "+ dot(w[2], d_w[0]) - dot(w[0], d_w[2])",
        "- dot(w[2], d_w[0]) + dot(w[0], d_w[2])",
        "a turned camera turns the ellipses the wrong way",
        _KERNELS,
    ),
    "rates_swapped": Mutant(
        "pipeline/training/loop/schedule.py",
        "log_scales=rates.scales_learning_rate * factor",
        "log_scales=rates.quats_learning_rate * factor",
        "the scales' learning rate taken from the rotations",
        ("tests/training/loop/test_first_step.py",),
    ),
    "decay_off_by_one": Mutant(
        "pipeline/training/loop/schedule.py",
        "t = (step - 1) / max(1, self.steps - 1)",
        "t = step / max(1, self.steps - 1)",
        "the means' learning rate one step ahead",
        ("tests/training/loop/test_schedule.py",),
    ),
    "unseen_kept": Mutant(
        "pipeline/training/loop/state.py",
        "seen = self.adam.last > before",
        "seen = self.adam.last > before - 10**6",
        "what no photograph saw kept",
        ("tests/training/loop/test_trainer.py",),
    ),
    "scene_by_cameras": Mutant(
        "pipeline/training/scene.py",
        "scale=scene_scale(extent, points)",
        "scale=extent",
        "a scene as large as its cameras stand apart",
        ("tests/training/test_scene.py",),
    ),
    "reset_not_loaded": Mutant(
        "pipeline/training/loop/device_step.py",
        'self.training.load_moments(self._optimised(), "opacity_logits")',
        "pass",
        "moments of opacities that the device keeps after a reset",
        ("tests/training/loop/test_device_density.py",),
    ),
    "moments_of_new_rows": Mutant(
        "pipeline/render/gpu/wgsl/take_rows.wgsl",
        "size.blanks != 0u && (row & kBlank) != 0u",
        "false",
        "new Gaussians with the moments of those that they were split from, on a device",
        ("tests/render/test_trained.py",),
    ),
    "late_reset": Mutant(
        "pipeline/training/density/gradient.py",
        "step + interval <= self.timeline.stop",
        "step <= self.timeline.stop",
        "an opacity reset with nothing after it to recover in",
        ("tests/training/density/test_timeline.py",),
    ),
    "split_grows": Mutant(
        "pipeline/training/density/growth.py",
        "halves.log_scales - math.log(SPLIT_SHRINK)",
        "halves.log_scales + math.log(SPLIT_SHRINK)",
        "halves of a split larger than the whole",
        ("tests/training/density/test_density.py",),
    ),
    "halves_together": Mutant(
        "pipeline/training/density/growth.py",
        "far[len(far) // 2 :] *= -1",
        "",
        "both halves of a split on one side",
        ("tests/training/density/test_density.py",),
    ),
    "pulled_at_go": Mutant(
        "pipeline/training/density/gradient.py",
        "idle & (opacity < RECYCLED_OPACITY)",
        "kept & (opacity < RECYCLED_OPACITY)",
        "faint Gaussians are recycled although their gradient is large",
        ("tests/training/density/test_density.py",),
    ),
    "alpha_unasked": Mutant(
        "pipeline/training/losses/alpha.py",
        "return PlaneGradients(alpha=add(masked, error))",
        "return PlaneGradients()",
        "what alpha and masks ask for left out of the steps",
        ("tests/training/loop/test_trainer.py",),
    ),
    "ndc": Mutant(
        "pipeline/render/cpu/backend.py",
        "*tensors, 0.5 * width, 0.5 * height",
        "*tensors, width, 0.5 * height",
        "the gradient of a mean in units of the width instead of NDC",
        ("tests/training/density/test_density.py",),
    ),
    "exposure_gradient": Mutant(
        "pipeline/training/losses/color.py",
        "            factor=self.light_factor(view.index, view.factor),\n",
        "",
        "exposure left out of the gradient",
        ("tests/training/loop/test_first_step.py",),
    ),
    "embedding_scale": Mutant(
        "pipeline/training/appearance/embedding.py",
        "weights = torch.from_numpy(embedding).float() * SH_C0",
        "weights = torch.from_numpy(embedding).float()",
        "the factor from SH coefficients to colours left out of the gradient of appearance",
        ("tests/training/appearance/test_embedding.py",),
    ),
    "embedding_kept": Mutant(
        "pipeline/training/loop/state.py",
        "            self.appearance.restore(arrays)",
        "            pass",
        "embeddings not restored from a checkpoint",
        ("tests/training/appearance/test_training.py",),
    ),
    "fitted_on_all": Mutant(
        "pipeline/training/appearance/fit.py",
        "left[:, : fitted_columns(photo.shape[1])] = True",
        "left[:] = True",
        "the appearance of a test view fitted on the half that is measured",
        ("tests/metrics/test_evaluate.py",),
    ),
    "exposure_free": Mutant(
        "pipeline/photos/exposure.py",
        "gains[measured] -= gains[measured].mean(axis=0)",
        "gains[measured] -= gains[measured].min(axis=0)",
        "the typical photograph's gain not 1",
        ("tests/photos/test_exposure.py",),
    ),
    "vignetting_of_all": Mutant(
        "pipeline/photos/shading.py",
        "rows = np.flatnonzero(seen.camera == camera)",
        "rows = np.flatnonzero(seen.camera >= 0)",
        "one vignetting for the lenses of all cameras",
        ("tests/photos/test_shading.py",),
    ),
    "untrusted_gains": Mutant(
        "pipeline/photos/shading.py",
        "return max(error, *halves)",
        "return 0.0",
        "gains kept on which the halves of an image disagree",
        ("tests/photos/test_shading.py",),
    ),
    "split_off_by_one": Mutant(
        "pipeline/scene/views.py",
        "return every > 0 and index % every == 0",
        "return every > 0 and index % every == 1",
        "the second of every eight views is the test view instead of the first",
        ("tests/scene/test_views.py",),
    ),
    "leak": Mutant(
        "pipeline/training/scene.py",
        "training = [view for view in scene.views if not view.is_test]",
        "training = list(scene.views)",
        "training on the test views",
        ("tests/e2e/test_regression.py",),
    ),
    "undistort_half_pixel": Mutant(
        "pipeline/photos/lens.py",
        "map_x[part], map_y[part] = xy[..., 0] - 0.5, xy[..., 1] - 0.5",
        "map_x[part], map_y[part] = xy[..., 0], xy[..., 1]",
        "undistorted pictures half a pixel off",
        ("tests/photos/test_undistort.py",),
    ),
    "sift_half_pixel": Mutant(
        "pipeline/sfm/sift.py",
        "table[:, :2] + 0.5,",
        "table[:, :2],",
        "keypoints half a pixel off",
        ("tests/sfm/test_features.py",),
    ),
    "resized_centre": Mutant(
        "pipeline/geometry/cameras.py",
        "np.array([fx * sx, fy * sy, cx * sx, cy * sy, *rest])",
        "np.array([fx * sx, fy * sy, cx * sx - 0.5, cy * sy - 0.5, *rest])",
        "the principal point half a pixel off in reduced pictures",
        ("tests/scene/test_views.py",),
    ),
    "opengl_axes": Mutant(
        "pipeline/io/poses/frames.py",
        "FLIP_YZ = np.diag([1.0, -1.0, -1.0])",
        "FLIP_YZ = np.diag([-1.0, -1.0, 1.0])",
        "transforms.json's axes taken for others",
        ("tests/io/test_transforms.py",),
    ),
    "quaternion": Mutant(
        "pipeline/geometry/rotations.py",
        "[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],",
        "[1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],",
        "a row of a rotation transposed",
        ("tests/io/test_colmap.py",),
    ),
    "spacing": Mutant(
        "pipeline/splats/init.py",
        "distances[:, 1 : NEIGHBOURS + 1].mean(1)",
        "distances[:, :NEIGHBOURS].mean(1)",
        "a point counted among its own neighbours",
        ("tests/splats/test_init.py",),
    ),
    "ply_order": Mutant(
        "pipeline/io/ply.py",
        "sh[:, 1:].transpose(0, 2, 1).reshape(count, len(rest)),",
        "sh[:, 1:].reshape(count, len(rest)),",
        "PLY's colours coefficient by coefficient instead of channel by channel",
        ("tests/io/test_ply.py",),
    ),
    "spz_rounding": Mutant(
        "pipeline/io/spz.py",
        "to_uint8((log_scales + np.log(_shrink(means, bits)) + 10) * 16)",
        "to_uint8((log_scales + np.log(_shrink(means, bits)) + 10) * 16 - 0.5)",
        "SPZ's scales cut off instead of rounded",
        ("tests/io/test_spz.py",),
    ),
    "spz_axes": Mutant(
        "pipeline/splats/axes.py",
        "(degree - m) % 2 == 1)",
        "m % 2 == 1)",
        "another program's axes with the wrong signs of spherical harmonics",
        ("tests/splats/test_axes.py",),
    ),
    "ssim_bands": Mutant(
        "pipeline/metrics/image.py",
        "first = max(rows.start - _RADIUS, 0)",
        "first = rows.start",
        "SSIM's bands of rows without the rows above that their windows reach",
        ("tests/metrics/test_image.py",),
    ),
    "psnr_peak": Mutant(
        "pipeline/metrics/image.py",
        "return min(-10.0 * np.log10(error), PSNR_CAP) if error > 0.0 else PSNR_CAP",
        "return min(-10.0 * np.log10(error) + 0.1, PSNR_CAP) if error > 0.0 else PSNR_CAP",
        "a tenth of a decibel too much",
        ("tests/metrics/test_image.py",),
    ),
    "ssim_window": Mutant(
        "pipeline/metrics/image.py",
        "_SIGMA = 1.5",
        "_SIGMA = 1.6",
        "another window in the SSIM that is reported",
        ("tests/metrics/test_image.py",),
    ),
    "pose_scale": Mutant(
        "pipeline/geometry/similarity.py",
        "return scale, rotation, mean_target - scale * rotation @ mean_source",
        "return scale, rotation, mean_target - rotation @ mean_source",
        "the scale left out of an alignment's shift",
        ("tests/metrics/test_pose.py",),
    ),
    "one_place": Mutant(
        "pipeline/training/data/image_store.py",
        "begin = self._end\n",
        "begin = 0\n",
        "pictures on disk written over one another",
        ("tests/training/data/test_targets.py",),
    ),
    "two_views": Mutant(
        "pipeline/training/density/floaters.py",
        "(found > WEIGHT_SHARE * total)",
        "(found > 0.0 * total)",
        "what two views agree on taken for a floater",
        ("tests/training/density/test_floaters.py",),
    ),
    "given_world": Mutant(
        "pipeline/sfm/known_poses.py",
        "        transform_model(model, fitted.similarity)",
        "        pass",
        "adjusted poses in a world turned from the given one",
        ("tests/sfm/test_refine.py",),
    ),
    "other_pairs": Mutant(
        "pipeline/sfm/matching.py",
        "(part, chunk(pairs, i, len(parts)))",
        "(part, chunk(pairs[::-1], i, len(parts)))",
        "matches of several jobs taken for those of other pairs",
        ("tests/sfm/test_chunks.py",),
    ),
    "weak_pairs": Mutant(
        "pipeline/sfm/pairs.py",
        "-scored[:, 0])",
        "scored[:, 0])",
        "the least similar photographs are matched",
        ("tests/sfm/test_pairs.py",),
    ),
    "judge": Mutant(
        "pipeline/sfm/judge.py",
        "e.parallax < MIN_PARALLAX[level],",
        "e.parallax < 0,",
        "a camera that only turned is believed",
        ("tests/sfm/test_judge.py",),
    ),
    "gains_of_other_views": Mutant(
        "pipeline/scene/exposure.py",
        "sorted(names - gains.root.keys()) if gains else []",
        "list[str]()",
        "exposure gains of another scene are used",
        ("tests/scene/test_exposure.py",),
    ),
    "file_without_version": Mutant(
        "pipeline/runtime/json_file.py",
        "sorted(cls.model_fields.keys() - content.model_fields_set)",
        "list[str]()",
        "a file of an older version is read as of this one",
        ("tests/runtime/test_json_file.py",),
    ),
}


@dataclass(frozen=True)
class Result:
    """The outcome of one fault. ``caught`` is the first failed test, or empty if all passed."""

    name: str
    caught: str
    seconds: float


def copy_project(target: Path) -> None:
    """Copy the sources, and the libraries that are already compiled from them."""
    built = Path(os.environ.get("SPLATMAKE_CACHE", ROOT / "build" / "native"))
    if built.is_dir():
        shutil.copytree(built, target.parent / "native")
    target.mkdir()
    ignored = shutil.ignore_patterns("__pycache__", ".pytest_cache")
    for source in ROOT.iterdir():
        if source.is_dir() and source.name in COPIED:
            shutil.copytree(source, target / source.name, ignore=ignored)
        elif source.is_file():
            shutil.copy(source, target / source.name)


def first_failure(project: Path, tests: Sequence[str]) -> str:
    """The first test that fails; empty if all pass.

    Raises:
        RuntimeError: The tests could not run at all.
    """
    missing = [test for test in tests if not (project / test).exists()]
    if missing:
        raise RuntimeError(f"no such tests: {', '.join(missing)}")
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *tests],
        cwd=project,
        # A changed kernel has a key of its own, so it is compiled anew.
        env=os.environ
        | {"SPLATMAKE_CACHE": str(project.parent / "native"), "PYTHONPATH": str(project)},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=SECONDS,
        check=False,
    )
    if done.returncode == 0:
        return ""
    failed = re.search(r"^(?:FAILED|ERROR) (\S+)", done.stdout, re.M)
    if done.returncode != 1 or failed is None:
        raise RuntimeError(f"pytest ended with {done.returncode}:\n{done.stdout[-3000:]}")
    return failed[1]


def try_mutant(name: str, project: Path) -> Result:
    """Insert the fault, run its tests, and remove it again."""
    mutant = MUTANTS[name]
    file = project / mutant.file
    text = file.read_text()
    if text.count(mutant.old) != 1:
        raise RuntimeError(f"{name}: {mutant.file} holds its text {text.count(mutant.old)} times")
    start = time.monotonic()
    file.write_text(text.replace(mutant.old, mutant.new))
    try:
        caught = first_failure(project, mutant.tests)
    finally:
        file.write_text(text)
    return Result(name, caught, time.monotonic() - start)


def row(result: Result) -> str:
    """A row of the Markdown table."""
    mutant = MUTANTS[result.name]
    caught = f"`{result.caught}`" if result.caught else "**survived**"
    return f"| {mutant.what} | `{mutant.file}` | {caught} | {result.seconds:.0f} |"


def main() -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.mutants",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("mutants", nargs="*", metavar="NAME", help=f"of {', '.join(MUTANTS)}")
    names = parser.parse_args().mutants or list(MUTANTS)
    unknown = set(names) - MUTANTS.keys()
    if unknown:
        parser.error(f"no such mutant: {', '.join(sorted(unknown))}")
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        project = Path(folder) / "project"
        copy_project(project)
        tests = list(dict.fromkeys(test for name in names for test in MUTANTS[name].tests))
        broken = first_failure(project, tests)
        if broken:
            print(f"error: without any fault, {broken} fails: mend that first", file=sys.stderr)
            return 2
        print("| fault | in | caught by | seconds |\n|---|---|---|---|", flush=True)
        survivors = []
        for name in names:
            result = try_mutant(name, project)
            print(row(result), flush=True)
            if not result.caught:
                survivors.append(name)
    print(f"\n{len(names)} faults, surviving: {', '.join(survivors) or 'none'}")
    return 1 if survivors else 0


if __name__ == "__main__":
    sys.exit(main())
