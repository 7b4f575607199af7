"""A checkpoint with a right digest and a wrong form is not used, and says so."""

from __future__ import annotations

import hashlib
import io
import json
from typing import Any

import numpy as np
import pytest

from pipeline.training.checkpoints.checkpoint import load_latest

GOOD = {"step": 3, "identity": "a", "values": {}}


def archive(**arrays: Any) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()


def header(**changes: Any) -> np.ndarray:
    return np.frombuffer(json.dumps(GOOD | changes).encode(), np.uint8)


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"PK\x03\x04",
        archive(means=np.zeros(3)),
        archive(__header__=np.frombuffer(b"[1]", np.uint8)),
        archive(__header__=np.frombuffer(b"{", np.uint8)),
        archive(__header__=header(step="3")),
        archive(__header__=header(step=-1)),
        archive(__header__=header(identity=None)),
        archive(__header__=header(values=[])),
        archive(__header__=header(), means=np.array([{}], object)),
    ],
)
def test_a_wrong_form_is_not_used(tmp_path, payload):
    file = tmp_path / "checkpoint_00000003.npz.sha256"
    file.write_bytes(payload + hashlib.sha256(payload).digest())
    said: list[str] = []
    assert load_latest(tmp_path, "a", said.append) is None
    assert said == [f"{file}: the checkpoint is damaged and not used"]
