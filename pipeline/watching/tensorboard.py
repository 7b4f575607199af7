"""Converts the journals of trainings to TensorBoard event files."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pipeline.runtime.errors import UserError
from pipeline.runtime.layout import install_extra
from pipeline.training.loop.metrics_log import NAME, MetricsRecord, read_metrics_log

SCALARS = {
    "loss": "train/loss",
    "psnr": "train/psnr_db",
    "num_gaussians": "scene/num_gaussians",
    "sh_degree": "scene/sh_degree",
    "resolution": "schedule/resolution",
    "share": "schedule/share",
    "memory_mb": "machine/memory_mb",
    "seconds": "machine/seconds",
}
FOLLOW_SECONDS = 5.0


def write_events(folders: Sequence[Path], out: Path, follow: bool) -> list[str]:
    """Write each run's journal into ``out/<run>``, replacing existing events.

    Args:
        folders: The results of runs (``results/NAME``), or the folder that contains them.
        follow: Keep writing new records until interrupted.

    Returns:
        Lines that describe what was written.

    Raises:
        UserError: No journal was found, or TensorBoard is not installed.
    """
    journals = {file.parent.parent.name: file for folder in folders for file in _journals(folder)}
    if not journals:
        raise UserError(
            f"expected {NAME} of a training in logs/, found none",
            file=folders[0],
            fix="train first; give a folder of a run (results/NAME) or of several runs",
        )
    writer = _writer()
    done = dict.fromkeys(journals, 0)
    for name in journals:
        for old in (out / name).glob("events.out.tfevents.*"):
            old.unlink()
    files = {name: writer(str(out / name)) for name in journals}
    try:
        while True:
            for name, file in journals.items():
                records = read_metrics_log(file)
                if len(records) < done[name]:
                    done[name] = 0  # The run has been restarted.
                for record in records[done[name] :]:
                    _write(files[name], record)
                done[name] = len(records)
                files[name].flush()
            if not follow:
                break
            time.sleep(FOLLOW_SECONDS)
    except KeyboardInterrupt:
        pass
    finally:
        for each in files.values():
            each.close()
    lines = [f"{out / name}: {count} records" for name, count in done.items()]
    return [*lines, f"view them with: tensorboard --logdir {out}"]


def _write(writer: Any, line: MetricsRecord) -> None:
    for name, tag in SCALARS.items():
        value = getattr(line, name)
        if value is not None:
            writer.add_scalar(tag, value, line.step, line.time)


def _journals(folder: Path) -> list[Path]:
    own = folder / "logs" / NAME
    return [own] if own.is_file() else sorted(folder.glob(f"*/logs/{NAME}"))


def _writer() -> Any:
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError as error:
        raise UserError(
            f"TensorBoard is not installed ({error})", fix=install_extra("watch")
        ) from None
    return SummaryWriter
