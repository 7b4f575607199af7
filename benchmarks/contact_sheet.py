"""One test view of a scene under every configuration of a batch, side by side, as an image.

    python -m benchmarks.contact_sheet results/benchmark.json --scene demo --out sheet.png

The captions are the configuration and the PSNR of the view. ``--configs`` selects configurations,
in that order; ``--view`` selects the view (default: the one of median PSNR in the first);
``--photograph`` puts the photograph first.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from PIL import Image, ImageDraw, ImageFont

from pipeline.config.runs import Run
from pipeline.reporting.data import ranked
from pipeline.reporting.metrics import read_metrics
from pipeline.runtime.errors import EXIT_USER_ERROR, UserError

GAP, LABEL = 6, 20  # pixels


def sheet(
    batch: Path,
    scene: str,
    configs: Sequence[str],
    view: str | None,
    width: int,
    columns: int,
    photograph: bool = False,
) -> Image.Image:
    """The contact sheet as an image.

    Args:
        batch: ``benchmark.json``, next to the folders of the runs.
        configs: configurations, in order; empty: all.
        view: name of the view; None: the median one of the first configuration.
        width: of one render, pixels.
        photograph: put the undistorted photograph of the view before the renders.

    Raises:
        UserError: the batch has no such scene, configuration or view, or cannot be read.
    """
    try:
        rows = json.loads(batch.read_text())["runs"]
    except (OSError, ValueError, KeyError) as error:
        raise UserError(f"expected a benchmark.json: {error}", file=batch) from error
    done: dict[str, Run] = {}  # first seed of each configuration
    for row in rows:
        if row["scene"] == scene and row["status"] == "ok":
            done.setdefault(row["config"], Run(scene, row["config"], row["seed"]))
    missing = [config for config in configs if config not in done]
    if missing or not done:
        raise UserError(
            f"no finished run {', '.join(f'{scene}@{config}' for config in missing) or scene}",
            file=batch,
            fix="take of these: "
            + ", ".join(f"{r['scene']}@{r['config']}" for r in rows if r["status"] == "ok"),
        )
    tiles: list[tuple[str, Image.Image]] = []
    for config in configs or done:
        # Folders of a batch without seeds have no seed in their name.
        named = batch.parent / done[config].name
        folder = named if named.is_dir() else batch.parent / Run(scene, config, None).name
        per_view = read_metrics(folder).per_view
        view = view or ranked(per_view, 1)[0][1].name
        found = next((v for v in per_view if v.name == view), None)
        if found is None:
            names = ", ".join(v.name for v in per_view)
            raise UserError(f"no test view {view}", file=folder, fix=f"choose one of: {names}")
        picture = _scaled(folder / "evaluate" / "renders" / found.render, width)
        if photograph and not tiles:
            original = folder / "undistort" / "images" / found.name
            if not original.is_file():
                raise UserError(
                    "the scene was not undistorted: no photograph at the renders' grid",
                    file=original,
                    fix="leave out --photograph",
                )
            tiles.append(("photograph", _scaled(original, width)))
        tiles.append((f"{config}  {found.psnr:.1f} dB", picture))
    return _laid_out(tiles, min(columns, len(tiles)))


def _scaled(path: Path, width: int) -> Image.Image:
    with Image.open(path) as opened:
        height = round(opened.height * width / opened.width)
        return opened.convert("RGB").resize((width, height), Image.Resampling.LANCZOS)


def _laid_out(tiles: Sequence[tuple[str, Image.Image]], columns: int) -> Image.Image:
    width = tiles[0][1].width + GAP
    height = max(picture.height for _, picture in tiles) + LABEL + GAP
    rows = -(-len(tiles) // columns)
    whole = Image.new("RGB", (columns * width + GAP, rows * height + GAP), "white")
    draw, font = ImageDraw.Draw(whole), ImageFont.load_default(13)
    for i, (label, picture) in enumerate(tiles):
        x, y = GAP + i % columns * width, GAP + i // columns * height
        whole.paste(picture, (x, y))
        draw.text((x + 2, y + picture.height + 2), label, "black", font)
    return whole


def main() -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.contact_sheet",
        description="One view under every configuration of a batch, as an image.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("batch", type=Path, metavar="benchmark.json")
    parser.add_argument("--scene", required=True)
    parser.add_argument(
        "--configs", nargs="+", default=[], help="configurations, in order (default: all)"
    )
    parser.add_argument("--view", help="name of a test view (default: the median one)")
    parser.add_argument("--photograph", action="store_true", help="put the photograph first")
    parser.add_argument("--width", type=int, default=240, help="of a render, pixels")
    parser.add_argument("--columns", type=int, default=4)
    parser.add_argument("--out", type=Path, required=True, metavar="FILE.png|.jpg")
    options = parser.parse_args()
    try:
        picture = sheet(
            options.batch, options.scene, options.configs, options.view, options.width,
            options.columns, options.photograph,
        )  # fmt: skip
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return EXIT_USER_ERROR
    options.out.parent.mkdir(parents=True, exist_ok=True)
    picture.save(options.out, optimize=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
