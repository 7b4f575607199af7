"""The devices of this machine, and the choice of the one to train on by a measurement, which is
stored for the next time. Importing this module does not import torch."""

from __future__ import annotations

import contextlib
import json
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

from pipeline.render.gpu.device import NO_GPU, Adapter, adapters
from pipeline.runtime import targets
from pipeline.runtime.atomic import write_json
from pipeline.runtime.errors import UserError
from pipeline.runtime.isolate import run_isolated
from pipeline.runtime.native import cache_folder

__all__ = ["Adapter", "DeviceChoice", "adapters", "check_device", "choose_device"]

RECORD = "devices.json"


@dataclass(frozen=True)
class DeviceChoice:
    """The device for ``train.device: auto``.

    Attributes:
        device: ``cpu`` or ``gpu:N``.
        reason: A sentence for plans, the same at every measurement; empty if there is no GPU.
        detail: A sentence for ``doctor``.
    """

    device: str
    reason: str
    detail: str


def choose_device() -> DeviceChoice:
    """Return a GPU if a step of a synthetic scene takes less time on it than on the processor. A
    GPU in software is never chosen."""
    if find_spec("wgpu") is None:
        return DeviceChoice("cpu", "", "on the processor; wgpu is not installed")
    found = adapters()
    real = [adapter for adapter in found if adapter.kind != "software"]
    if not real:
        what = f"the only one found, {found[0].name}, is software" if found else "none was found"
        return DeviceChoice("cpu", "", f"on the processor, not on a GPU: {what}")
    adapter = real[0]
    times = _times_of(adapter)
    if isinstance(times, str):
        reason = f"trained on the processor, since {adapter} fails"
        return DeviceChoice("cpu", reason, f"on the processor; {adapter} fails: {times}")
    gpu, cpu = times
    compared = f"a step of a synthetic scene takes {1e3 * gpu:.0f} ms on {adapter}, "
    compared += f"{1e3 * cpu:.0f} on the processor"
    if gpu < cpu:
        reason = f"trained on {adapter}, where a step takes less time than on the processor"
        return DeviceChoice(f"gpu:{adapter.number}", reason, f"on the GPU: {compared}")
    reason = f"trained on the processor, where a step takes less time than on {adapter}"
    return DeviceChoice("cpu", reason, f"on the processor: {compared}")


def check_device(device: str) -> None:
    """Check that this machine has the device that ``train.device`` names: ``gpu`` or ``gpu:N``.

    Raises:
        UserError: The package wgpu is not installed, or there is no such GPU.
    """
    kind, _, number = device.partition(":")
    if kind != "gpu":
        return
    found = adapters()
    if int(number or 0) >= len(found):
        there = "; ".join(f"gpu:{adapter.number} is {adapter}" for adapter in found)
        raise UserError(
            f"train.device: {device}: this machine has no such GPU"
            + (f"; {there}" if found else ", and no other one"),
            fix="name one of them, or set train.device: cpu" if found else NO_GPU,
        )


def _times_of(adapter: Adapter) -> tuple[float, float] | str:
    """Seconds of a step on a GPU and on the processor, or why there are none."""
    file = cache_folder() / RECORD
    key = f"{adapter}, {adapter.driver}, {targets.usable()[0].name}"
    known: dict[str, Any] = {}
    try:
        known = dict(json.loads(file.read_text("utf-8")))
        if isinstance(known[key], str):
            return str(known[key])
        gpu, cpu = map(float, known[key])
        return gpu, cpu
    except (OSError, ValueError, KeyError, TypeError):
        pass
    times: tuple[float, float] | str
    try:
        # The steps are timed in a process of their own, since drivers crash.
        times = run_isolated(time_steps, f"gpu:{adapter.number}")
    except UserError as error:
        times = error.what
    except RuntimeError as error:
        times = str(error).strip().splitlines()[-1]
    with contextlib.suppress(OSError):  # The record is optional: it is measured again.
        write_json(file, {**known, key: times})
    return times


def time_steps(device: str) -> tuple[float, float]:
    """Seconds of a step on a GPU and on the processor, measured."""
    from pipeline.render.calibration import step_seconds
    from pipeline.render.registry import make_backend

    return step_seconds(make_backend(device)), step_seconds(make_backend("cpu"))
