"""The command ``splatmake``: reconstruct a scene; convert, render, measure and view Gaussians of
any program; compare batches; examine the machine."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

from pipeline.config.presets import PRESETS
from pipeline.render.registry import DEVICE
from pipeline.runtime.errors import EXIT_INTERRUPTED, EXIT_USER_ERROR, UserError, as_user_error
from pipeline.runtime.machine import usable_cores

MODEL = "file of Gaussians: .ply, .spz, .splat, .glb, or the pipeline's own .npz"
EXAMPLES = """examples:
  splatmake run photos/garden --preset fast --cores 4
  splatmake plan photos/garden
  splatmake view results/garden
  splatmake convert point_cloud.ply scene.spz --min-opacity 0.02
  splatmake render scene.spz --cameras data/garden/sparse/0 -o renders
  splatmake evaluate point_cloud.ply --scene results/garden
  splatmake compare results/benchmark.json --base balanced
  splatmake doctor

In a checkout, `python -m pipeline` is the same command, and
`snakemake --cores all results/NAME/metrics.json` reconstructs data/NAME.
"""
# Commands that pass further options to Snakemake.
WORKFLOW_COMMANDS = ("run", "plan")
# The largest whole number that an argument takes.
_MAX_NUMBER = 1_000_000


def main(arguments: list[str] | None = None) -> int:
    """Run a command and return the exit code: 2 after a ``UserError``."""
    options = _parse(sys.argv[1:] if arguments is None else arguments)
    command: Callable[..., int | None] = options.pop("command")
    try:
        code = command(**options)
    except UserError as error:
        return _fail(error)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED
    except OSError as error:
        known = as_user_error(error)
        if known is None:
            raise
        return _fail(known)
    return code or 0


def _parse(arguments: list[str]) -> dict[str, Any]:
    parser = _parser()
    if arguments[:1] and arguments[0] in WORKFLOW_COMMANDS:
        # "--" before Snakemake's options is optional.
        mark = arguments.index("--") if "--" in arguments else len(arguments)
        known, others = parser.parse_known_args(arguments[:mark] + arguments[mark + 1 :])
        return vars(known) | {"options": others}
    return vars(parser.parse_args(arguments))


def _fail(error: UserError) -> int:
    print(f"error: {error}", file=sys.stderr)
    return EXIT_USER_ERROR


# Commands import what they need, so that --help and wrong options do not import torch.


def _run(**options: Any) -> None:
    from pipeline.command.workflow import replace_process, snakemake_command

    replace_process(snakemake_command(**options))


def _plan(options: list[str], **others: Any) -> None:
    _run(options=["--dry-run", *options], **others)


def _compare(**options: Any) -> None:
    from pipeline.reporting.compare import compare

    _print(compare(**options), [])


def _convert(**options: Any) -> None:
    from pipeline.commands import convert

    warnings: list[str] = []
    _print(convert(**options, warnings=warnings), warnings)


def _render(
    device: str, threads: int, background: str, antialias: bool, max_side: int, **options: Any
) -> None:
    from pipeline.commands import Rendering, render
    from pipeline.render.registry import use_device

    use_device(device)

    warnings: list[str] = []
    how = Rendering(background, antialias, max_side, threads)
    _print(render(**options, how=how, warnings=warnings), warnings)


def _evaluate(
    device: str, threads: int, background: str, antialias: bool, max_side: int, **options: Any
) -> None:
    from pipeline.commands import Rendering, evaluate
    from pipeline.render.registry import use_device

    use_device(device)

    found = evaluate(**options, how=Rendering(background, antialias, max_side, threads))
    width = max(len(view.name) for view in found.per_view)
    protocol = found.protocol
    lpips = "" if found.lpips is None else f", LPIPS {found.lpips:.4f}"
    means = f"PSNR {found.psnr:.2f} dB, SSIM {found.ssim:.4f}{lpips}"
    lines = [
        *(
            f"{view.name:<{width}}  {view.psnr:6.2f} dB  SSIM {view.ssim:.4f}"
            for view in found.per_view
        ),
        f"{means}, {protocol.num_views} views",
        f"({protocol.split}; {', '.join(protocol.resolution)} pixels)",
    ]
    _print(lines, found.warnings)


def _view(model: Path, cameras: Path | None, device: str, **options: Any) -> None:
    from pipeline.render.registry import use_device
    from pipeline.watching.server import serve
    from pipeline.watching.source import Source

    use_device(device)
    serve(Source(model, cameras), **options)


def _tensorboard(**options: Any) -> None:
    from pipeline.watching.tensorboard import write_events

    _print(write_events(**options), [])


def _doctor(json_wanted: bool, results: Path) -> int:
    from pipeline import doctor

    found = doctor.examine(results)
    text = json.dumps(doctor.as_data(found), indent=2) if json_wanted else None
    _print([text] if text else doctor.as_text(found), [])
    return 0 if doctor.is_ready(found) else EXIT_USER_ERROR


def _print(lines: Sequence[str], warnings: Sequence[str]) -> None:
    for text in warnings:
        print(f"warning: {text}", file=sys.stderr)
    for line in lines:
        print(line)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="splatmake",
        description="Reconstruct a scene from photographs; convert, render, measure and view "
        "Gaussians of any program; compare batches; examine the machine.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"%(prog)s {_version()}")
    commands = parser.add_subparsers(metavar="COMMAND", required=True)

    for name, command, text in (
        ("run", _run, "reconstruct a scene from a folder of photographs"),
        ("plan", _plan, "show the stages that run would execute, with reasons, and the jobs"),
    ):
        sub = commands.add_parser(
            name,
            help=text,
            description=f"{text[0].upper()}{text[1:]}. Results are in results/ of the current "
            "folder, and config/config.yaml there is read if it exists. All other options are "
            "Snakemake's; they follow the folder.",
            allow_abbrev=False,
        )
        sub.set_defaults(command=command)
        _add_workflow(sub)

    sub = commands.add_parser(
        "convert", help="convert Gaussians to another format, optionally with fewer coefficients"
    )
    sub.set_defaults(command=_convert)
    sub.add_argument("source", type=Path, metavar="MODEL", help=MODEL)
    sub.add_argument("target", type=Path, metavar="OUT", help="file to write, by its suffix")
    sub.add_argument(
        "--sh-degree", type=int, choices=range(4), default=3, help="largest degree (default 3)"
    )
    sub.add_argument(
        "--min-opacity",
        type=_share,
        default=0.0,
        metavar="SHARE",
        help="remove Gaussians with a lower opacity, 0 to 1 (default 0)",
    )
    sub.add_argument(
        "--morton-order", action="store_true", help="sort along a Z-order curve: smaller files"
    )

    sub = commands.add_parser("render", help="render Gaussians from given cameras, to PNG")
    sub.set_defaults(command=_render)
    sub.add_argument("model", type=Path, metavar="MODEL", help=MODEL)
    sub.add_argument(
        "--cameras",
        type=Path,
        required=True,
        metavar="PATH",
        help="COLMAP model (its folder, or one with sparse/0), transforms.json, or results/NAME",
    )
    sub.add_argument(
        "-o", "--out", type=Path, required=True, metavar="FOLDER", help="folder for the images"
    )
    sub.add_argument(
        "--view",
        dest="names",
        action="append",
        default=[],
        metavar="NAME",
        help="only this view, with or without suffix; can be repeated",
    )
    _add_rendering(sub, "black", "without")

    sub = commands.add_parser(
        "evaluate",
        help="PSNR and SSIM of each view against its photograph",
        description="Evaluate a model on the scene's test views: PSNR and SSIM of each view "
        "against its photograph, and their means.",
    )
    sub.set_defaults(command=_evaluate)
    sub.add_argument("model", type=Path, metavar="MODEL", help=MODEL)
    sub.add_argument(
        "--scene",
        type=Path,
        required=True,
        metavar="FOLDER",
        help="finished scene (results/NAME), or photographs with poses (COLMAP's sparse/0, "
        "transforms.json, poses_bounds.npy) without lens distortion",
    )
    sub.add_argument(
        "-o", "--out", type=Path, metavar="FOLDER", help="folder for renders and evaluation.json"
    )
    sub.add_argument(
        "--every",
        type=_every,
        metavar="N",
        help="every N-th view, sorted by name, is a test view; 0: evaluate all views "
        "(default: as the scene was trained, else 8)",
    )
    _add_rendering(sub, "the scene's", "as the scene was trained")

    sub = commands.add_parser(
        "view",
        help="show a scene in the browser, also during training (needs viser)",
        description="Show a scene in the browser, rendered by the rasterizer of the training. "
        "During training, the newest checkpoint is shown and updated twice a minute.",
    )
    sub.set_defaults(command=_view)
    sub.add_argument(
        "model", type=Path, metavar="SCENE", help="results/NAME, or with --cameras a " + MODEL
    )
    sub.add_argument(
        "--cameras", type=Path, metavar="PATH", help="as for render (default: the scene's own)"
    )
    sub.add_argument(
        "--host", default="127.0.0.1", help="0.0.0.0: accessible to others (default: %(default)s)"
    )
    sub.add_argument(
        "--allow-host",
        dest="allowed_hosts",
        action="append",
        default=[],
        metavar="NAME",
        help="answer requests that name this host or come from its pages, as behind a proxy; can "
        "be repeated (default: only localhost, this machine's name and addresses in numbers)",
    )
    sub.add_argument("--port", type=_positive, default=8080, help="(default: %(default)s)")
    sub.add_argument(
        "--side", type=_positive, default=800, metavar="PIXELS", help="longer side (default: 800)"
    )
    _add_device(sub)
    sub.add_argument(
        "--threads", type=_positive, default=1, help="(default: 1, leaving the others to training)"
    )

    sub = commands.add_parser(
        "compare",
        help="tables of a batch (results/benchmark.json), or of two",
        description="Tables of batches in Markdown: each configuration compared with --base, each "
        "run, or the differences between two batches of the same runs.",
    )
    sub.set_defaults(command=_compare)
    sub.add_argument("batches", type=Path, nargs="+", metavar="BENCHMARK_JSON", help="one or two")
    sub.add_argument(
        "--base",
        metavar="CONFIG",
        help="configuration that others are compared with (default: the default preset)",
    )
    sub.add_argument(
        "--each", action="store_true", help="list each run of one batch, without comparison"
    )

    sub = commands.add_parser(
        "tensorboard", help="write training curves for TensorBoard (needs tensorboard)"
    )
    sub.set_defaults(command=_tensorboard)
    sub.add_argument(
        "folders", type=Path, nargs="+", metavar="FOLDER", help="results/NAME, or results for all"
    )
    sub.add_argument(
        "-o", "--out", type=Path, required=True, metavar="FOLDER", help="folder for the files"
    )
    sub.add_argument(
        "--follow", action="store_true", help="continue with running trainings, until Ctrl-C"
    )

    sub = commands.add_parser(
        "doctor",
        help="show what this machine has, what is used, and what is missing",
        description="Report processor, instruction set, compilers, memory, graphics cards, "
        "packages and disk (+ used, - optional and absent, ! required and missing), and what to "
        "do. The exit code is 2 if something required is missing.",
    )
    sub.set_defaults(command=_doctor)
    sub.add_argument("--json", dest="json_wanted", action="store_true", help="print JSON")
    sub.add_argument(
        "--results",
        type=Path,
        default=Path("results"),
        metavar="FOLDER",
        help="folder of the results, whose disk is examined (default: %(default)s)",
    )
    return parser


def _add_workflow(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("scene", type=Path, metavar="FOLDER", help="the scene's photographs")
    parser.add_argument(
        "--preset", choices=tuple(PRESETS), help="(default: the configuration file's)"
    )
    parser.add_argument(
        "-c", "--cores", default="all", metavar="N", help="processor cores to use (default: all)"
    )
    parser.add_argument(
        "-C",
        "--config",
        nargs="+",
        action="extend",
        default=[],
        metavar="NAME=VALUE",
        help="options of the pipeline, such as 'train={steps: 2000}'",
    )
    parser.add_argument(
        "--workflow-profile",
        dest="profile",
        metavar="PROFILE",
        help="Snakemake profile: a folder, or one of the program's: ci, slurm",
    )


def _version() -> str:
    try:
        return metadata.version("splatmake")
    except metadata.PackageNotFoundError:
        return "(a checkout)"


def _add_rendering(parser: argparse.ArgumentParser, background: str, antialias: str) -> None:
    parser.add_argument(
        "--background", choices=("black", "white"), help=f"behind the scene (default: {background})"
    )
    parser.add_argument(
        "--antialias",
        action=argparse.BooleanOptionalAction,
        help=f"Mip-Splatting's opacity compensation (default: {antialias})",
    )
    _add_device(parser)
    parser.add_argument(
        "--max-side", type=_positive, metavar="PIXELS", help="reduce larger views to this"
    )
    parser.add_argument(
        "--threads", type=_positive, default=usable_cores(), help="(default: all cores)"
    )


def _add_device(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--device", type=_device, default="cpu", help="cpu, gpu or gpu:N (default: cpu)"
    )


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
