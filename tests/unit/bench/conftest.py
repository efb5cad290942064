"""Fixtures of the tests of benchmarks."""

from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results of the one run that all tests of a module share."""
    return tmp_path_factory.mktemp("bench")
