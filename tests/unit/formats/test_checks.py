"""Checks that readers share: claims of headers are refused before memory is allocated."""

from __future__ import annotations

from pathlib import Path

import pytest

from splatbot.checksums import write_sums
from splatbot.errors import FormatError
from splatbot.formats.checks import MAX_EXPANSION, MAX_GAUSSIANS, check_count, check_expansion, read_bytes


@pytest.mark.parametrize("count", [0, -1, MAX_GAUSSIANS + 1, 2**40])
def test_an_impossible_count_names_file_and_field(count: int) -> None:
    with pytest.raises(FormatError, match="Gaussians") as caught:
        check_count("a.spz", count, "numPoints")
    assert (caught.value.file, caught.value.field) == ("a.spz", "numPoints")
    assert caught.value.hint


def test_counts_and_sizes_in_proportion_pass() -> None:
    check_count("a.spz", 1, "numPoints")
    check_count("a.spz", MAX_GAUSSIANS, "numPoints")
    check_expansion("a.spz", 2**26, 10, "numPoints")
    check_expansion("a.spz", MAX_EXPANSION * 10**8, 10**8, "numPoints")


@pytest.mark.parametrize(("decoded", "stored"), [(2**26 + 1, 1000), (MAX_EXPANSION * 10**8 + 1, 10**8)])
def test_a_bomb_is_refused(decoded: int, stored: int) -> None:
    with pytest.raises(FormatError, match="claims") as caught:
        check_expansion("a.spz", decoded, stored, "numPoints")
    assert caught.value.field == "numPoints"


def test_a_file_that_its_folder_knows_otherwise_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "map.spz"
    path.write_bytes(b"one")
    write_sums(tmp_path, ["map.spz"])
    assert read_bytes(path) == b"one"
    path.write_bytes(b"two")
    with pytest.raises(FormatError, match="checksum"):
        read_bytes(path)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="No such file") as caught:
        read_bytes(tmp_path / "none.spz")
    assert caught.value.file == str(tmp_path / "none.spz")
