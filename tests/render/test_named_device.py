"""A device that the configuration names is looked for before any job starts."""

from __future__ import annotations

import pytest

from pipeline.render import devices
from pipeline.render.devices import Adapter, check_device
from pipeline.runtime.errors import UserError

GPUS = [Adapter(0, "Card", "driver", "discrete", "Vulkan")]


@pytest.mark.parametrize(
    ("found", "device", "said"),
    [
        ([], "gpu", "train.device: gpu: this machine has no such GPU, and no other one"),
        ([], "gpu:0", "no other one"),
        (GPUS, "gpu:1", r"gpu:1: this machine has no such GPU; gpu:0 is Card \(discrete, Vulkan\)"),
        (GPUS, "gpu:999", "gpu:0 is Card"),
    ],
)
def test_a_gpu_that_is_not_there_is_an_error(
    monkeypatch: pytest.MonkeyPatch, found: list[Adapter], device: str, said: str
) -> None:
    monkeypatch.setattr(devices, "adapters", lambda: found)
    with pytest.raises(UserError, match=said):
        check_device(device)


@pytest.mark.parametrize("device", ["cpu", "gpu", "gpu:0"])
def test_a_device_that_is_there_is_accepted(monkeypatch: pytest.MonkeyPatch, device: str) -> None:
    monkeypatch.setattr(devices, "adapters", lambda: GPUS)
    check_device(device)
