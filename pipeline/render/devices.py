"""The devices of this machine, and which of them to train on: decided by a measurement, which is
stored for the next time. Importing this module does not import torch."""

from __future__ import annotations

import json
from importlib.util import find_spec
from pathlib import Path

from pipeline.render.gpu.device import Adapter, adapters
from pipeline.runtime import targets
from pipeline.runtime.atomic import write_json
from pipeline.runtime.errors import UserError
from pipeline.runtime.native import cache_folder

__all__ = ["Adapter", "adapters", "choose_device"]

RECORD = "devices.json"


def choose_device() -> tuple[str, str]:
    """The device for ``train.device: auto``, and the sentence that gives it and the reason; the
    latter is empty if wgpu is not installed."""
    if find_spec("wgpu") is None:
        return "cpu", ""
    found = adapters()
    real = [adapter for adapter in found if adapter.kind != "software"]
    if not real:
        what = f"the only one found, {found[0].name}, is software" if found else "none was found"
        return "cpu", f"trained on the processor, not on a GPU: {what}"
    adapter = real[0]
    try:
        gpu, cpu = _measured(str(adapter), adapter.driver, f"gpu:{adapter.number}")
    except UserError as error:
        return "cpu", f"trained on the processor, since the GPU fails: {error.what}"
    times = f"a step of a made scene takes {1e3 * gpu:.0f} ms on {adapter}, {1e3 * cpu:.0f} without"
    if gpu < cpu:
        return f"gpu:{adapter.number}", f"trained on the GPU: {times}"
    return "cpu", f"trained on the processor: {times}"


def _measured(name: str, driver: str, device: str) -> tuple[float, float]:
    """Seconds of a step on the GPU and on the processor."""
    file: Path = cache_folder() / RECORD
    key = f"{name}, {driver}, {targets.usable()[0].name}"
    try:
        known = json.loads(file.read_text("utf-8"))
        gpu, cpu = known[key]
        return float(gpu), float(cpu)
    except (OSError, ValueError, KeyError, TypeError):
        known = {}
    # Torch takes seconds to import, and plans do without.
    from pipeline.render.calibration import step_seconds
    from pipeline.render.registry import make_backend

    times = step_seconds(make_backend(device)), step_seconds(make_backend("cpu"))
    write_json(file, {**(known if isinstance(known, dict) else {}), key: list(times)})
    return times
