"""The command ``splatmake``: reconstruct scenes; convert, render, measure and view Gaussians of any
program; compare batches; examine the machine."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable, Sequence
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from pipeline.command import parser as types
from pipeline.command.parser import Parser
from pipeline.command.workflow import add_workflow_commands
from pipeline.runtime.errors import (
    EXIT_INTERRUPTED,
    EXIT_NOT_ACCEPTED,
    EXIT_USER_ERROR,
    UserError,
    as_user_error,
)
from pipeline.runtime.layout import COMMAND
from pipeline.runtime.machine import usable_cores
from pipeline.runtime.suggest import check_exists

if TYPE_CHECKING:
    from pipeline.commands import Rendering

MODEL = "file of Gaussians (.ply, .spz, .sog, .splat, .glb, or .npz of the results)"
# The commands that pass further options to Snakemake.
WORKFLOW_COMMANDS = ("run", "plan", "batch")
# The arguments that are existing files or folders.
_INPUTS = ("source", "model", "cameras", "scene", "folders")


def main(arguments: list[str] | None = None) -> int:
    """Run a command and return the exit code: 2 after a ``UserError``."""
    try:
        options = _parse(sys.argv[1:] if arguments is None else arguments)
        run: Callable[..., int | None] = options.pop("command")
        for name in _INPUTS:
            for path in _as_list(options.get(name)):
                check_exists(path)
        return run(**options) or 0
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED
    except BrokenPipeError:  # What read the output has ended, as `head` does.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except (UserError, OSError) as error:
        known = error if isinstance(error, UserError) else as_user_error(error)
        if known is None:
            raise
        print(f"error: {known}", file=sys.stderr)
        return EXIT_USER_ERROR


def _as_list(value: Any) -> list[Path]:
    return value if isinstance(value, list) else [] if value is None else [value]


def _parse(arguments: list[str]) -> dict[str, Any]:
    """The arguments of a command, with the function that runs it as ``command``.

    Raises:
        UserError: An argument is wrong or missing.
    """
    parser = make_parser(COMMAND)
    name = next(iter(arguments), "--help")
    # The "--" before Snakemake's options is optional.
    mark = arguments.index("--") if name in WORKFLOW_COMMANDS and "--" in arguments else None
    words = arguments if mark is None else arguments[:mark] + arguments[mark + 1 :]
    known, others = parser.parse_known_args(words or [name])
    options = vars(known)
    if name in WORKFLOW_COMMANDS:
        return options | {"options": others}
    if others:
        options["parser"].unknown(others)
    del options["parser"]
    return options


def make_parser(program: str = "splatmake") -> Parser:
    """The parser of the command line.

    Args:
        program: The name of the program in usages and examples.
    """
    parser = Parser(
        prog=program,
        description="Reconstruct scenes from photographs; convert, render, measure and view "
        "Gaussians of any program; compare batches; examine the machine.",
        epilog=f"example:\n  {program} run photos/garden --preset fast\n"
        f"  {program} view results/garden\n\n{program} COMMAND --help describes a command.",
    )
    parser.add_argument("--version", action="version", version=f"splatmake {_version()}")
    commands = parser.add_subparsers(metavar="COMMAND", required=True)

    def command(
        name: str,
        run: Callable[..., int | None],
        text: str,
        example: str,
        about: str | None = None,
    ) -> Callable[..., object]:
        """Add a command, and return the ``add_argument`` of its parser."""
        about = about or f"{text[0].upper()}{text[1:]}."
        epilog = f"example:\n  {program} {name} {example}".rstrip()
        sub = commands.add_parser(name, help=text, description=about, epilog=epilog)
        sub.set_defaults(command=run, parser=sub)
        return sub.add_argument

    add_workflow_commands(command)
    text = "show a scene in the browser, also during training"
    about = (
        "Show a scene in the browser. During training, the newest checkpoint is shown and "
        "updated twice a minute."
    )
    _add_view(command("view", _view, text, "results/garden", about))
    text = "write a folder to upload: the page and its files"
    about = "Write a folder to upload: the page of a scene and its exported files."
    add = command("publish", _publish, text, "results/garden upload/garden", about)
    _add_publish(add)
    text = "convert Gaussians to another file format"
    example = "point_cloud.ply garden.spz --min-opacity 0.02"
    _add_convert(command("convert", _convert, text, example))
    example = "garden.spz --cameras results/garden -o renders"
    _add_render(command("render", _render, "render Gaussians from given cameras, to PNG", example))
    text = "PSNR, SSIM and FLIP of Gaussians against a scene's photographs"
    about = "PSNR, SSIM and FLIP of each test view against its photograph, and their means."
    example = "point_cloud.ply --scene results/garden"
    _add_evaluate(command("evaluate", _evaluate, text, example, about))
    _add_accept(command)
    text = "tables of a batch, or of two"
    about = (
        "Tables of batches in Markdown: each configuration compared with --base, each run, or the "
        "differences between two batches of the same runs."
    )
    _add_compare(command("compare", _compare, text, "results --base fast", about))
    text = "write training curves for TensorBoard"
    _add_tensorboard(command("tensorboard", _tensorboard, text, "results -o curves --follow"))
    text = "list the options of --config and explain them"
    about = (
        "Explain options, or without a name list all with their defaults, as a configuration file."
    )
    add = command("options", _options, text, "train.steps", about)
    text = "option or section, such as train.steps or train"
    add("names", nargs="*", metavar="NAME", help=text)
    text = "download the weights of LPIPS"
    about = "Download the weights of LPIPS into torch's folder ($TORCH_HOME or ~/.cache/torch)."
    _add_fetch(command("fetch", _fetch, text, "lpips", about))
    text = "show what this machine has, what is used, and what is missing"
    about = (
        "Report processor, compilers, memory, graphics cards, packages and disk (+ used, - "
        "optional and absent, ! required and missing), and what to do. The exit code is 2 if "
        "something required is missing."
    )
    _add_doctor(command("doctor", _doctor, text, "", about))
    return parser


# Each command is a function that adds its arguments, and the function that runs it. Commands import
# what they need, so that --help and wrong options do not import torch.


def _add_convert(add: Callable[..., object]) -> None:
    add("source", type=Path, metavar="MODEL", help=MODEL)
    add("target", type=Path, metavar="OUT", help="file to write, by its suffix")
    add("--sh-degree", type=int, choices=range(4), default=3, help="largest degree (default 3)")
    text = "remove Gaussians with a lower opacity, 0 to 1 (default 0)"
    add("--min-opacity", type=types.share, default=0.0, metavar="SHARE", help=text)
    text = "merge them to this many and refine these; needs --cameras"
    add("--max-gaussians", type=types.gaussians, metavar="N", help=text)
    text = "keep what lies in a box, in the frame and unit of MODEL"
    corners = ("X0", "Y0", "Z0", "X1", "Y1", "Z1")
    add("--box", type=float, nargs=6, metavar=corners, help=text)
    text = "keep what most cameras have in their images; needs --cameras"
    add("--subject", action="store_true", help=text)
    text = "as for render; the cost of what is left out is measured on these views"
    add("--cameras", type=Path, metavar="PATH", help=text)
    text = "sort along a Z-order curve: smaller files"
    add("--morton-order", action="store_true", help=text)
    text = "version of an .spz file (default 3, which more programs read)"
    add("--spz-version", type=int, choices=(3, 4), default=3, help=text)


def _convert(**options: Any) -> None:
    from pipeline.commands import Wanted, convert

    warnings: list[str] = []
    names = ("max_gaussians", "box", "subject", "cameras")
    wanted = Wanted(**{name: options.pop(name) for name in names})
    _print(convert(**options, wanted=wanted, warnings=warnings), warnings)


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
    add("--every", type=types.every, metavar="N", help=text)
    _add_rendering(add, "the scene's", "as the scene was trained")


def _evaluate(**options: Any) -> None:
    from pipeline.commands import evaluate

    how = _rendering(options)
    found = evaluate(**options, how=how)
    width = max(len(view.name) for view in found.per_view)
    lines = [
        f"{view.name:<{width}}  {view.psnr:6.2f} dB  SSIM {view.ssim:.4f}  FLIP {view.flip:.4f}"
        for view in found.per_view
    ]
    protocol = found.protocol
    lpips = "" if found.lpips is None else f", LPIPS {found.lpips:.4f}"
    means = f"PSNR {found.psnr:.2f} dB, SSIM {found.ssim:.4f}, FLIP {found.flip:.4f}{lpips}"
    lines.append(f"{means}, {protocol.num_views} views")
    lines.append(f"({protocol.split}; {', '.join(protocol.resolution)} pixels)")
    _print(lines, found.warnings)


def _add_rendering(add: Callable[..., object], background: str, antialias: str) -> None:
    text = f"behind the scene (default: {background})"
    add("--background", choices=("black", "white"), help=text)
    text = f"Mip-Splatting's opacity compensation (default: {antialias})"
    add("--antialias", action=argparse.BooleanOptionalAction, help=text)
    _add_device(add)
    add("--max-side", type=types.positive, metavar="PIXELS", help="reduce larger views to this")
    add("--threads", type=types.positive, default=usable_cores(), help="(default: all cores)")


def _rendering(options: dict[str, Any]) -> Rendering:
    """Take the arguments of ``_add_rendering`` out of ``options``, and use their device."""
    from pipeline.commands import Rendering
    from pipeline.render.registry import use_device

    use_device(options.pop("device"))
    names = ("background", "antialias", "max_side", "threads")
    return Rendering(**{name: options.pop(name) for name in names})


def _add_device(add: Callable[..., object]) -> None:
    add("--device", type=types.device, default="cpu", help="cpu, gpu or gpu:N (default: cpu)")


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
    add("--port", type=types.positive, default=8080, help="(default: %(default)s)")
    text = "longer side (default: %(default)s)"
    add("--side", type=types.positive, default=800, metavar="PIXELS", help=text)
    _add_device(add)
    text = "(default: 1, leaving the others to training)"
    add("--threads", type=types.positive, default=1, help=text)


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


def _add_accept(command: Callable[..., Callable[..., object]]) -> None:
    text = "say whether a result meets rules, for CI"
    about = (
        "Judge a finished scene by rules, and say for each what is wanted and found. The exit code "
        "is 0 if all are met, 1 if not, 2 after an error."
    )
    example = "results/garden --rules config/acceptance.yaml"
    add = command("accept", _accept, text, example, about)
    add("scene", type=Path, metavar="SCENE", help="finished scene: results/NAME")
    text = "rules in YAML (default: those of docs/reference/acceptance.md)"
    add("--rules", type=Path, metavar="FILE", help=text)
    text = "accepted.json, results/NAME or metrics.json to compare with (default: the rules')"
    add("--baseline", type=Path, metavar="PATH", help=text)
    text = "write the judgement to this file, a baseline of later ones"
    add("--json", dest="target", type=Path, metavar="FILE", help=text)


def _accept(scene: Path, rules: Path | None, **options: Any) -> int:
    from pipeline.reporting.acceptance.command import accept

    if rules is None:
        print("the default rules apply; --rules names a file of others")
    judged, lines = accept(scene, rules, **options)
    _print(lines)
    return 0 if judged.accepted else EXIT_NOT_ACCEPTED


def _add_compare(add: Callable[..., object]) -> None:
    text = "results folder of a batch, or its benchmark.json; one or two (default: results)"
    add("batches", type=Path, nargs="*", default=[Path("results")], metavar="BATCH", help=text)
    text = "configuration that others are compared with (default: the first)"
    add("--base", metavar="CONFIG", help=text)
    text = "list each run of one batch, without comparison"
    add("--each", action="store_true", help=text)


def _compare(**options: Any) -> None:
    from pipeline.reporting.compare import compare

    _print(compare(**options))


def _options(names: list[str]) -> None:
    from pipeline.command.options import describe

    _print(describe(names))


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


def _add_fetch(add: Callable[..., object]) -> None:
    add("what", choices=("lpips",), help="lpips: backbone and linear heads")
    text = "vgg (553 MB; the default) or alex (244 MB)"
    add("--net", choices=("vgg", "alex"), default="vgg", help=text)


def _fetch(what: str, net: Literal["vgg", "alex"]) -> None:
    from pipeline.metrics.lpips import fetch_weights

    _print(fetch_weights(net))


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


if __name__ == "__main__":
    sys.exit(main())
