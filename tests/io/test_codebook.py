"""Codebooks of 256 values."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.io.codebook import make_codebook, nearest_entries


def error(values: np.ndarray, codebook: np.ndarray) -> float:
    return float(((values - codebook[nearest_entries(codebook, values)]) ** 2).mean())


@pytest.mark.parametrize("kind", ["normal", "laplace", "uniform", "outlier"])
def test_a_codebook_is_better_than_quantiles_and_equal_steps(kind) -> None:
    rng = np.random.default_rng(0)
    values = {
        "normal": rng.normal(size=20_000),
        "laplace": rng.laplace(size=20_000),
        "uniform": rng.random(20_000),
        "outlier": np.append(rng.normal(size=20_000), 1e4),
    }[kind]
    found = error(values, make_codebook(values))
    quantiles = np.quantile(values, (np.arange(256) + 0.5) / 256).astype(np.float32)
    steps = np.linspace(values.min(), values.max(), 256).astype(np.float32)
    assert found <= 1.01 * min(error(values, quantiles), error(values, steps))
    # Panter and Dite's bound of the error of a normal distribution.
    if kind == "normal":
        assert found < 1.03 * np.sqrt(3) * np.pi / 2 / 256**2


def test_few_different_values_are_kept_exactly() -> None:
    values = np.random.default_rng(0).normal(size=200).astype(np.float32).repeat(3)
    codebook = make_codebook(values)
    assert len(codebook) == 256 and (np.diff(codebook) >= 0).all()
    np.testing.assert_array_equal(codebook[nearest_entries(codebook, values)], values)


def test_each_value_has_its_nearest_entry() -> None:
    values = np.random.default_rng(0).normal(size=3000)
    codebook = make_codebook(values)
    nearest = np.abs(values[:, None] - codebook.astype(np.float64)).argmin(1)
    np.testing.assert_array_equal(codebook[nearest_entries(codebook, values)], codebook[nearest])
