"""A checkpoint with a right digest and arrays of another run is not used: training starts again."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.training.checkpoints import checkpoint
from pipeline.training.loop import session
from tests.training.conftest import TinyScene
from tests.training.loop.test_trainer import assert_same, interrupt_at, run

Change = Callable[[dict[str, np.ndarray], dict[str, Any]], object]


def swap(name: str, change: Callable[[np.ndarray], np.ndarray]) -> Change:
    return lambda arrays, values: arrays.update({name: change(arrays[name])})


def put(**fields: object) -> Change:
    return lambda arrays, values: values.update(fields)


CHANGES: dict[str, Change] = {
    "type": swap("parameter.means", lambda a: a.astype(np.float64)),
    "integers": swap("parameter.quats", lambda a: a.astype(np.int32)),
    "rows": swap("parameter.quats", lambda a: a[:-1]),
    "columns": swap("parameter.means", lambda a: a[:, :2]),
    "none": swap("parameter.means", lambda a: a[:0]),
    "flat": swap("parameter.log_scales", lambda a: a.ravel()),
    "scalar": swap("parameter.means", lambda a: np.float32(1.0)),
    "bands": swap("parameter.sh", lambda a: np.repeat(a, 2, axis=1)),
    "moments": swap("first.sh", lambda a: a[:, :1]),
    "last": swap("last", lambda a: a[:-1]),
    "statistics": swap("seen", lambda a: np.zeros(7, a.dtype)),
    "order": swap("order", lambda a: a * 0),
    "views": swap("order", lambda a: np.arange(len(a) + 3)),
    "negative": swap("order", lambda a: a - 1),
    "missing": lambda arrays, values: arrays.pop("second.means"),
    "another": lambda arrays, values: arrays.update(extra=np.zeros(3)),
    "no generator": put(rng=None),
    "another generator": put(rng={"bit_generator": "MT19937"}),
    "position": put(position=10**9),
    "clock": put(clock="3"),
    "counters": put(counters={"changes": {}, "unknown": 3}),
    "window": put(window=[]),
    "curve": put(curve=[{"step": -1}]),
    "seconds": put(seconds=None),
}


@pytest.fixture(scope="module")
def whole(scene: TinyScene, tmp_path_factory: pytest.TempPathFactory) -> Any:
    return run(scene, tmp_path_factory.mktemp("whole"))


@pytest.fixture
def saved(scene: TinyScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of checkpoints of a run that ended early."""
    monkeypatch.setattr(session, "CHECKPOINT_SECONDS", 0.0)
    with monkeypatch.context() as context, pytest.raises(KeyboardInterrupt):
        interrupt_at(context, 12)
        run(scene, tmp_path)
    return tmp_path


@pytest.mark.parametrize("change", CHANGES)
def test_arrays_of_another_form_are_not_used(scene, whole, saved, change):
    latest = sorted(saved.glob(checkpoint.PATTERN))[-1]
    found = checkpoint.newest(saved)
    assert found is not None
    CHANGES[change](found.arrays, found.values)
    for file in saved.glob(checkpoint.PATTERN):
        file.unlink()
    assert checkpoint.save(saved, found) == latest
    said: list[str] = []
    assert_same(whole, run(scene, saved, said=said))
    assert len([line for line in said if "is not used, because" in line]) == 1, said


def test_the_same_arrays_are_used(scene, whole, saved):
    said: list[str] = []
    assert_same(whole, run(scene, saved, said=said))
    assert not any("not used" in line for line in said)
