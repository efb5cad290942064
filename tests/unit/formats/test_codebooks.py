"""Codebooks: ends and few values are exact, and the mean error is that of even steps or less."""

from __future__ import annotations

import numpy as np
import pytest

from splatbot.formats.codebooks import nearest_entries, number_codebook, vector_codebook


@pytest.mark.parametrize("kind", ["normal", "outliers", "uniform"])
def test_numbers_are_no_further_on_average_than_with_even_steps(kind: str, rng: np.random.Generator) -> None:
    drawn = rng.normal(size=30_000) if kind != "uniform" else rng.uniform(-1, 1, 30_000)
    if kind == "outliers":
        drawn[:20] *= 1000
    values = drawn.astype(np.float32)
    entries = number_codebook(values, 256)
    assert len(entries) == 256
    assert (np.diff(entries) >= 0).all()
    assert entries[[0, -1]].tolist() == [values.min(), values.max()]
    errors = np.abs(entries[nearest_entries(entries, values)] - values)
    step = np.ptp(values) / 255
    assert np.sqrt(np.mean(errors**2)) <= 1.02 * step / np.sqrt(12)  # of values that are uniform within steps
    gaps = np.diff(entries)
    cell = np.clip(np.searchsorted(entries, values) - 1, 0, 254)
    assert (errors <= 0.5 * gaps[cell] + 1e-6 * np.abs(values)).all()


def test_few_distinct_numbers_are_exact() -> None:
    values = np.array([3.0, -1.0, 3.0, 0.5], np.float32)
    entries = number_codebook(values, 256)
    assert entries.tolist() == [-1.0, 0.5, 3.0]
    assert entries[nearest_entries(entries, values)].tolist() == values.tolist()


def test_rare_numbers_outside_of_the_sample_do_not_spoil_the_ends() -> None:
    values = np.tile(np.arange(100, dtype=np.float32), 10_000)
    values[12_345] = -7.5
    entries = number_codebook(values, 256)
    assert entries[nearest_entries(entries, values)].tolist() == values.tolist()


def test_few_distinct_vectors_represent_themselves(rng: np.random.Generator) -> None:
    vectors = rng.normal(size=(50, 9)).astype(np.float32)[rng.integers(0, 50, 1000)]
    codebook, labels = vector_codebook(vectors, 64)
    assert len(codebook) <= 50
    assert np.array_equal(codebook[labels], vectors)


def test_many_vectors_share_a_codebook_of_means(rng: np.random.Generator) -> None:
    centres = rng.normal(size=(40, 15)).astype(np.float32)
    vectors = (centres[rng.integers(0, 40, 5000)] + 0.01 * rng.normal(size=(5000, 15))).astype(np.float32)
    codebook, labels = vector_codebook(vectors, 512)
    assert codebook.shape == (512, 15)
    assert labels.shape == (5000,)
    errors = np.linalg.norm(codebook[labels] - vectors, axis=1)
    assert np.median(errors) < 0.05  # within a cluster, whose spread is 0.01 √15; clusters are 5 apart
    assert np.array_equal(vector_codebook(vectors, 512)[1], labels)
