"""The command ``splatmake``: reconstruct a scene; convert, render, measure and view Gaussians,
whatever program trained them; compare batches; examine the machine."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any

from pipeline.config.presets import PRESETS
from pipeline.runtime.errors import EXIT_USER_ERROR, UserError, as_user_error
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
# Whose further options are Snakemake's.
WORKFLOW_COMMANDS = ("run", "plan")


def main(arguments: list[str] | None = None) -> int:
    """Run a command and return the process's exit code: 2 where the user must mend something."""
    options = _parse(sys.argv[1:] if arguments is None else arguments)
    command: Callable[..., int | None] = options.pop("command")
    try:
        code = command(**options)
    except UserError as error:
        return _fail(error)
    except OSError as error:
        known = as_user_error(error)
        if known is None:
            raise
        return _fail(known)
    return code or 0


def _parse(arguments: list[str]) -> dict[str, Any]:
    parser = _parser()
    if arguments[:1] and arguments[0] in WORKFLOW_COMMANDS:
        # "--" may set Snakemake's options apart; they are recognised without it, too.
        mark = arguments.index("--") if "--" in arguments else len(arguments)
        known, others = parser.parse_known_args(arguments[:mark] + arguments[mark + 1 :])
        return vars(known) | {"options": others}
    return vars(parser.parse_args(arguments))


def _fail(error: UserError) -> int:
    print(f"error: {error}", file=sys.stderr)
    return EXIT_USER_ERROR


# Torch and all that is imported by the commands: --help and wrong options need none of it.


def _run(**options: Any) -> None:
    from pipeline.command.workflow import become, snakemake_command

    become(snakemake_command(**options))


def _plan(options: list[str], **others: Any) -> None:
    _run(options=["--dry-run", *options], **others)


def _compare(**options: Any) -> None:
    from pipeline.reporting.compare import compare

    _tell(compare(**options), [])


def _convert(**options: Any) -> None:
    from pipeline.commands import convert

    warnings: list[str] = []
    _tell(convert(**options, warnings=warnings), warnings)


def _render(threads: int, background: str, antialias: bool, max_side: int, **options: Any) -> None:
    from pipeline.commands import Rendering, render

    warnings: list[str] = []
    how = Rendering(background, antialias, max_side, threads)
    _tell(render(**options, how=how, warnings=warnings), warnings)


def _evaluate(
    threads: int, background: str, antialias: bool, max_side: int, **options: Any
) -> None:
    from pipeline.commands import Rendering, evaluate

    found = evaluate(**options, how=Rendering(background, antialias, max_side, threads))
    width = max(len(view["name"]) for view in found["per_view"])
    protocol = found["protocol"]
    lpips = "" if found["lpips"] is None else f", LPIPS {found['lpips']:.4f}"
    means = f"PSNR {found['psnr']:.2f} dB, SSIM {found['ssim']:.4f}{lpips}"
    lines = [
        *(
            f"{view['name']:<{width}}  {view['psnr']:6.2f} dB  SSIM {view['ssim']:.4f}"
            for view in found["per_view"]
        ),
        f"{means}, {protocol['num_views']} views",
        f"({protocol['split']}; {', '.join(protocol['resolution'])} pixels)",
    ]
    _tell(lines, found["warnings"])


def _view(model: Path, cameras: Path | None, **options: Any) -> None:
    from pipeline.watching.server import serve
    from pipeline.watching.source import Source

    serve(Source(model, cameras), **options)


def _tensorboard(**options: Any) -> None:
    from pipeline.watching.tensorboard import write_events

    _tell(write_events(**options), [])


def _doctor(json_wanted: bool, results: Path) -> int:
    from pipeline import doctor

    found = doctor.examine(results)
    text = json.dumps(doctor.as_data(found), indent=2) if json_wanted else None
    _tell([text] if text else doctor.as_text(found), [])
    return 0 if doctor.is_ready(found) else EXIT_USER_ERROR


def _tell(lines: list[str], warnings: list[str]) -> None:
    for text in warnings:
        print(f"warning: {text}", file=sys.stderr)
    for line in lines:
        print(line)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="splatmake",
        description="Reconstruct a scene from photographs; convert, render, measure and view "
        "Gaussians, whatever program trained them; compare batches; examine the machine.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"%(prog)s {_version()}")
    commands = parser.add_subparsers(metavar="COMMAND", required=True)

    for name, command, text in (
        ("run", _run, "reconstruct a scene from a folder of photographs"),
        ("plan", _plan, "show what run would do: the stages and why, and the jobs"),
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
        "convert", help="write Gaussians in another format, fewer or simpler ones if asked for"
    )
    sub.set_defaults(command=_convert)
    sub.add_argument("source", type=Path, metavar="MODEL", help=MODEL)
    sub.add_argument("target", type=Path, metavar="OUT", help="file to write, by its suffix")
    sub.add_argument(
        "--sh-degree", type=int, choices=range(4), default=3, help="cut higher bands (default 3)"
    )
    sub.add_argument(
        "--min-opacity",
        type=_share,
        default=0.0,
        metavar="SHARE",
        help="leave fainter Gaussians out, 0 to 1 (default 0)",
    )
    sub.add_argument(
        "--morton-order", action="store_true", help="sort along a Z-order curve: smaller files"
    )

    sub = commands.add_parser("render", help="render Gaussians as given cameras see them, to PNG")
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
        "-o", "--out", type=Path, required=True, metavar="FOLDER", help="folder for the pictures"
    )
    sub.add_argument(
        "--view",
        dest="names",
        action="append",
        default=[],
        metavar="NAME",
        help="only this view, with or without suffix; may be given several times",
    )
    _add_rendering(sub, "black", "without")

    sub = commands.add_parser(
        "evaluate",
        help="PSNR and SSIM of each view against its photograph",
        description="Measure a model on the scene's held-out views: PSNR and SSIM of each view "
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
        "-o", "--out", type=Path, metavar="FOLDER", help="keep renders and evaluation.json here"
    )
    sub.add_argument(
        "--every",
        type=_every,
        metavar="N",
        help="held-out views are each N-th, sorted by name; 0 measures on all "
        "(default: as the scene was trained, else 8)",
    )
    _add_rendering(sub, "the scene's", "as the scene was trained")

    sub = commands.add_parser(
        "view",
        help="show a scene in the browser, also while it is being trained (needs viser)",
        description="A page in the browser that shows a scene, rendered by the rasterizer that "
        "trains it. Of a training under way it shows the newest checkpoint, two a minute.",
    )
    sub.set_defaults(command=_view)
    sub.add_argument(
        "model", type=Path, metavar="SCENE", help="results/NAME, or with --cameras a " + MODEL
    )
    sub.add_argument(
        "--cameras", type=Path, metavar="PATH", help="as for render (default: the scene's own)"
    )
    sub.add_argument(
        "--host", default="127.0.0.1", help="0.0.0.0 lets others in (default: %(default)s)"
    )
    sub.add_argument("--port", type=_positive, default=8080, help="(default: %(default)s)")
    sub.add_argument(
        "--side", type=_positive, default=800, metavar="PIXELS", help="longer side (default: 800)"
    )
    sub.add_argument(
        "--threads", type=_positive, default=1, help="(default: 1, for a training needs the rest)"
    )

    sub = commands.add_parser(
        "compare",
        help="tables of a batch (results/benchmark.json), or of two",
        description="Tables of batches in Markdown: each configuration beside --base, each run, or "
        "how well a second batch repeats the first.",
    )
    sub.set_defaults(command=_compare)
    sub.add_argument("batches", type=Path, nargs="+", metavar="BENCHMARK_JSON", help="one or two")
    sub.add_argument(
        "--base",
        metavar="CONFIG",
        help="the configuration that others are compared with (default: the default preset)",
    )
    sub.add_argument("--each", action="store_true", help="each run of one batch, without comparing")

    sub = commands.add_parser(
        "tensorboard", help="write trainings' curves as TensorBoard's files (needs tensorboard)"
    )
    sub.set_defaults(command=_tensorboard)
    sub.add_argument(
        "folders", type=Path, nargs="+", metavar="FOLDER", help="results/NAME, or results for all"
    )
    sub.add_argument(
        "-o", "--out", type=Path, required=True, metavar="FOLDER", help="folder for the files"
    )
    sub.add_argument(
        "--follow", action="store_true", help="go on with what trainings add, until Ctrl-C"
    )

    sub = commands.add_parser(
        "doctor",
        help="show what this machine has, what of it is used, and what is missing",
        description="Processor and instruction set, compilers, memory, graphics cards, packages "
        "and disk: what is there (+ used, - optional and absent, ! needed and missing) and what "
        "to do. Exits with 2 where something needed is missing.",
    )
    sub.set_defaults(command=_doctor)
    sub.add_argument("--json", dest="json_wanted", action="store_true", help="print JSON")
    sub.add_argument(
        "--results",
        type=Path,
        default=Path("results"),
        metavar="FOLDER",
        help="where results go: its disk is examined (default: %(default)s)",
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
        help="Snakemake profile: a folder, or ci or slurm for those of the program",
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
    parser.add_argument(
        "--max-side", type=_positive, metavar="PIXELS", help="reduce larger views to this"
    )
    parser.add_argument(
        "--threads", type=_positive, default=usable_cores(), help="(default: all cores)"
    )


def _share(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0 <= value <= 1:
        raise argparse.ArgumentTypeError(f"expected a number from 0 to 1, found {text!r}")
    return value


def _positive(text: str) -> int:
    if not text.isdecimal() or int(text) == 0:
        raise argparse.ArgumentTypeError(f"expected a positive whole number, found {text!r}")
    return int(text)


def _every(text: str) -> int:
    if not text.isdecimal() or int(text) == 1:
        raise argparse.ArgumentTypeError(f"expected 0, 2 or more, found {text!r}")
    return int(text)


if __name__ == "__main__":
    sys.exit(main())
