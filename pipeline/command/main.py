"""The command ``splatmake``: reconstruct a scene; convert, render, measure and view Gaussians of
any program; compare batches; examine the machine."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.config.presets import PRESETS
from pipeline.render.registry import DEVICE
from pipeline.runtime.errors import EXIT_INTERRUPTED, EXIT_USER_ERROR, UserError, as_user_error
from pipeline.runtime.machine import usable_cores

if TYPE_CHECKING:
    from pipeline.commands import Rendering

MODEL = "file of Gaussians: .ply, .spz, .splat, .glb, or the pipeline's own .npz"
EXAMPLES = """examples:
  splatmake run photos/garden --preset fast --cores 4
  splatmake plan photos/garden
  splatmake view results/garden
  splatmake convert point_cloud.ply scene.spz --min-opacity 0.02
  splatmake render scene.spz --cameras data/garden/sparse/0 -o renders
  splatmake evaluate point_cloud.ply --scene results/garden
  splatmake compare results/benchmark.json --base balanced
  splatmake publish results/garden upload/garden
  splatmake doctor

In a checkout, `python -m pipeline` is the same command, and
`snakemake --cores all results/NAME/metrics.json` reconstructs data/NAME.
"""
# The commands that pass further options to Snakemake.
WORKFLOW_COMMANDS = ("run", "plan")
# The largest whole number that an argument takes.
_MAX_NUMBER = 1_000_000


def main(arguments: list[str] | None = None) -> int:
    """Run a command and return the exit code: 2 after a ``UserError``."""
    options = _parse(sys.argv[1:] if arguments is None else arguments)
    run: Callable[..., int | None] = options.pop("command")
    try:
        return run(**options) or 0
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED
    except (UserError, OSError) as error:
        known = error if isinstance(error, UserError) else as_user_error(error)
        if known is None:
            raise
        print(f"error: {known}", file=sys.stderr)
        return EXIT_USER_ERROR


def _parse(arguments: list[str]) -> dict[str, Any]:
    parser = make_parser()
    if arguments[:1] and arguments[0] in WORKFLOW_COMMANDS:
        # The "--" before Snakemake's options is optional.
        mark = arguments.index("--") if "--" in arguments else len(arguments)
        known, others = parser.parse_known_args(arguments[:mark] + arguments[mark + 1 :])
        return vars(known) | {"options": others}
    return vars(parser.parse_args(arguments))


def make_parser() -> argparse.ArgumentParser:
    """The parser of the command line."""
    parser = argparse.ArgumentParser(
        prog="splatmake",
        description="Reconstruct a scene from photographs; convert, render, measure and view "
        "Gaussians of any program; compare batches; examine the machine.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"%(prog)s {_version()}")
    commands = parser.add_subparsers(metavar="COMMAND", required=True)

    def command(
        name: str, run: Callable[..., int | None], text: str, about: str | None = None, **more: Any
    ) -> Callable[..., object]:
        """Add a command, and return the ``add_argument`` of its parser."""
        sub = commands.add_parser(name, help=text, description=about, **more)
        sub.set_defaults(command=run)
        return sub.add_argument

    for name, run, text in (
        ("run", _run, "reconstruct a scene from a folder of photographs"),
        ("plan", _plan, "show the stages that run would execute, with reasons, and the jobs"),
    ):
        about = (
            f"{text[0].upper()}{text[1:]}. Results are in results/ of the current folder, and "
            "config/config.yaml there is read if it exists. All other options are Snakemake's; "
            "they follow the folder."
        )
        _add_workflow(command(name, run, text, about, allow_abbrev=False))
    text = "convert Gaussians to another format, optionally with fewer coefficients"
    _add_convert(command("convert", _convert, text))
    _add_render(command("render", _render, "render Gaussians from given cameras, to PNG"))
    text = "PSNR and SSIM of each view against its photograph"
    about = f"Evaluate a model on the scene's test views: {text}, and their means."
    _add_evaluate(command("evaluate", _evaluate, text, about))
    text = "show a scene in the browser, also during training (needs viser)"
    about = (
        "Show a scene in the browser, rendered by the rasterizer of the training. During training, "
        "the newest checkpoint is shown and updated twice a minute."
    )
    _add_view(command("view", _view, text, about))
    text = "write a folder to upload: the page of a scene and its exported files"
    _add_publish(command("publish", _publish, text))
    text = "tables of a batch (results/benchmark.json), or of two"
    about = (
        "Tables of batches in Markdown: each configuration compared with --base, each run, or the "
        "differences between two batches of the same runs."
    )
    _add_compare(command("compare", _compare, text, about))
    text = "write training curves for TensorBoard (needs tensorboard)"
    _add_tensorboard(command("tensorboard", _tensorboard, text))
    text = "show what this machine has, what is used, and what is missing"
    about = (
        "Report processor, instruction set, compilers, memory, graphics cards, packages and disk "
        "(+ used, - optional and absent, ! required and missing), and what to do. The exit code is "
        "2 if something required is missing."
    )
    _add_doctor(command("doctor", _doctor, text, about))
    return parser


# Each command is a function that adds its arguments, and the function that runs it. Commands import
# what they need, so that --help and wrong options do not import torch.


def _add_workflow(add: Callable[..., object]) -> None:
    add("scene", type=Path, metavar="FOLDER", help="the scene's photographs")
    add("--preset", choices=tuple(PRESETS), help="(default: the configuration file's)")
    add("-c", "--cores", default="all", metavar="N", help="processor cores to use (default: all)")
    add(
        *("-C", "--config"),
        nargs="+",
        action="extend",
        default=[],
        metavar="NAME=VALUE",
        help="options of the pipeline, such as 'train={steps: 2000}'",
    )
    add(
        "--workflow-profile",
        dest="profile",
        metavar="PROFILE",
        help="Snakemake profile: a folder, or one of the program's: ci, slurm",
    )


def _run(**options: Any) -> None:
    from pipeline.command.workflow import replace_process, snakemake_command

    replace_process(snakemake_command(**options))


def _plan(options: list[str], **others: Any) -> None:
    _run(options=["--dry-run", *options], **others)


def _add_convert(add: Callable[..., object]) -> None:
    add("source", type=Path, metavar="MODEL", help=MODEL)
    add("target", type=Path, metavar="OUT", help="file to write, by its suffix")
    add("--sh-degree", type=int, choices=range(4), default=3, help="largest degree (default 3)")
    text = "remove Gaussians with a lower opacity, 0 to 1 (default 0)"
    add("--min-opacity", type=_share, default=0.0, metavar="SHARE", help=text)
    text = "sort along a Z-order curve: smaller files"
    add("--morton-order", action="store_true", help=text)


def _convert(**options: Any) -> None:
    from pipeline.commands import convert

    warnings: list[str] = []
    _print(convert(**options, warnings=warnings), warnings)


def _add_render(add: Callable[..., object]) -> None:
    add("model", type=Path, metavar="MODEL", help=MODEL)
    text = "COLMAP model (its folder, or one with sparse/0), transforms.json, or results/NAME"
    add("--cameras", type=Path, required=True, metavar="PATH", help=text)
    text = "folder for the images"
    add("-o", "--out", type=Path, required=True, metavar="FOLDER", help=text)
    text = "only this view, with or without suffix; can be repeated"
    add("--view", dest="names", action="append", default=[], metavar="NAME", help=text)
    _add_rendering(add, "black", "without")


def _render(**options: Any) -> None:
    from pipeline.commands import render

    warnings: list[str] = []
    how = _rendering(options)
    _print(render(**options, how=how, warnings=warnings), warnings)


def _add_evaluate(add: Callable[..., object]) -> None:
    add("model", type=Path, metavar="MODEL", help=MODEL)
    text = (
        "finished scene (results/NAME), or photographs with poses (COLMAP's sparse/0, "
        "transforms.json, poses_bounds.npy) without lens distortion"
    )
    add("--scene", type=Path, required=True, metavar="FOLDER", help=text)
    text = "folder for renders and evaluation.json"
    add("-o", "--out", type=Path, metavar="FOLDER", help=text)
    text = (
        "every N-th view, sorted by name, is a test view; 0: evaluate all views (default: as the "
        "scene was trained, else 8)"
    )
    add("--every", type=_every, metavar="N", help=text)
    _add_rendering(add, "the scene's", "as the scene was trained")


def _evaluate(**options: Any) -> None:
    from pipeline.commands import evaluate

    how = _rendering(options)
    found = evaluate(**options, how=how)
    width = max(len(view.name) for view in found.per_view)
    lines = [
        f"{view.name:<{width}}  {view.psnr:6.2f} dB  SSIM {view.ssim:.4f}"
        for view in found.per_view
    ]
    protocol = found.protocol
    lpips = "" if found.lpips is None else f", LPIPS {found.lpips:.4f}"
    means = f"PSNR {found.psnr:.2f} dB, SSIM {found.ssim:.4f}{lpips}"
    lines.append(f"{means}, {protocol.num_views} views")
    lines.append(f"({protocol.split}; {', '.join(protocol.resolution)} pixels)")
    _print(lines, found.warnings)


def _add_rendering(add: Callable[..., object], background: str, antialias: str) -> None:
    text = f"behind the scene (default: {background})"
    add("--background", choices=("black", "white"), help=text)
    text = f"Mip-Splatting's opacity compensation (default: {antialias})"
    add("--antialias", action=argparse.BooleanOptionalAction, help=text)
    _add_device(add)
    add("--max-side", type=_positive, metavar="PIXELS", help="reduce larger views to this")
    add("--threads", type=_positive, default=usable_cores(), help="(default: all cores)")


def _rendering(options: dict[str, Any]) -> Rendering:
    """Take the arguments of ``_add_rendering`` out of ``options``, and use their device."""
    from pipeline.commands import Rendering
    from pipeline.render.registry import use_device

    use_device(options.pop("device"))
    names = ("background", "antialias", "max_side", "threads")
    return Rendering(**{name: options.pop(name) for name in names})


def _add_device(add: Callable[..., object]) -> None:
    add("--device", type=_device, default="cpu", help="cpu, gpu or gpu:N (default: cpu)")


def _add_view(add: Callable[..., object]) -> None:
    text = "results/NAME, or with --cameras a " + MODEL
    add("model", type=Path, metavar="SCENE", help=text)
    text = "as for render (default: the scene's own)"
    add("--cameras", type=Path, metavar="PATH", help=text)
    text = "0.0.0.0: accessible to others (default: %(default)s)"
    add("--host", default="127.0.0.1", help=text)
    add(
        "--allow-host",
        dest="allowed_hosts",
        action="append",
        default=[],
        metavar="NAME",
        help="answer requests that name this host or come from its pages, as behind a proxy; can "
        "be repeated (default: only localhost, this machine's name and addresses in numbers)",
    )
    add("--port", type=_positive, default=8080, help="(default: %(default)s)")
    text = "longer side (default: 800)"
    add("--side", type=_positive, default=800, metavar="PIXELS", help=text)
    _add_device(add)
    text = "(default: 1, leaving the others to training)"
    add("--threads", type=_positive, default=1, help=text)


def _view(model: Path, cameras: Path | None, device: str, **options: Any) -> None:
    from pipeline.render.registry import use_device
    from pipeline.watching.server import serve
    from pipeline.watching.source import Source

    use_device(device)
    serve(Source(model, cameras), **options)


def _add_publish(add: Callable[..., object]) -> None:
    add("scene", type=Path, metavar="SCENE", help="finished scene: results/NAME")
    text = "folder to write: new, empty, or published before"
    add("target", type=Path, metavar="DIR", help=text)


def _publish(**options: Any) -> None:
    from pipeline.reporting.publish import publish

    _print(publish(**options))


def _add_compare(add: Callable[..., object]) -> None:
    add("batches", type=Path, nargs="+", metavar="BENCHMARK_JSON", help="one or two")
    text = "configuration that others are compared with (default: the default preset)"
    add("--base", metavar="CONFIG", help=text)
    text = "list each run of one batch, without comparison"
    add("--each", action="store_true", help=text)


def _compare(**options: Any) -> None:
    from pipeline.reporting.compare import compare

    _print(compare(**options))


def _add_tensorboard(add: Callable[..., object]) -> None:
    text = "results/NAME, or results for all"
    add("folders", type=Path, nargs="+", metavar="FOLDER", help=text)
    text = "folder for the files"
    add("-o", "--out", type=Path, required=True, metavar="FOLDER", help=text)
    text = "continue with running trainings, until Ctrl-C"
    add("--follow", action="store_true", help=text)


def _tensorboard(**options: Any) -> None:
    from pipeline.watching.tensorboard import write_events

    _print(write_events(**options))


def _add_doctor(add: Callable[..., object]) -> None:
    add("--json", dest="json_wanted", action="store_true", help="print JSON")
    text = "folder of the results, whose disk is examined (default: %(default)s)"
    add("--results", type=Path, default=Path("results"), metavar="FOLDER", help=text)


def _doctor(json_wanted: bool, results: Path) -> int:
    from pipeline import doctor

    found = doctor.examine(results)
    data = doctor.as_data(found)
    _print([json.dumps(data, indent=2)] if json_wanted else doctor.as_text(found))
    return 0 if doctor.is_ready(found) else EXIT_USER_ERROR


def _print(lines: Sequence[str], warnings: Sequence[str] = ()) -> None:
    for text in warnings:
        print(f"warning: {text}", file=sys.stderr)
    for line in lines:
        print(line)


def _version() -> str:
    try:
        return metadata.version("splatmake")
    except metadata.PackageNotFoundError:
        return "(a checkout)"


def _device(text: str) -> str:
    if not DEVICE.fullmatch(text):
        raise argparse.ArgumentTypeError(f"expected cpu, gpu or gpu:N, found {text!r}")
    return text


def _share(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0 <= value <= 1:
        raise argparse.ArgumentTypeError(f"expected a number from 0 to 1, found {text!r}")
    return value


def _positive(text: str) -> int:
    return _whole_number(text, (0,), "a positive whole number")


def _every(text: str) -> int:
    return _whole_number(text, (1,), "0, 2 or more")


def _whole_number(text: str, refused: tuple[int, ...], expected: str) -> int:
    number = int(text) if text.isdecimal() and len(text) <= 10 else -1
    if not 0 <= number <= _MAX_NUMBER or number in refused:
        expected += f", at most {_MAX_NUMBER}" if number > _MAX_NUMBER else ""
        raise argparse.ArgumentTypeError(f"expected {expected}, found {text[:40]!r}")
    return number


if __name__ == "__main__":
    sys.exit(main())
