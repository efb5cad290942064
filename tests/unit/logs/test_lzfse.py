"""LZFSE streams: their announced sizes against the encoder, and streams that announce too much."""

from __future__ import annotations

import struct
import sys
from contextlib import suppress
from pathlib import Path

import liblzfse
import numpy as np
import pytest

from splatbot.errors import LogError
from splatbot.logs.lzfse import decompress, raw_size

RNG = np.random.default_rng(0)
CONTENTS = [
    b"a" * 10,
    b"a" * 100_000,
    RNG.bytes(50_000),
    np.linspace(1, 3, 49_152, dtype=np.float32).tobytes(),
    RNG.normal(2, 0.3, 49_152).round(2).astype(np.float32).tobytes(),
    RNG.normal(2, 0.3, 720 * 960).astype(np.float32).tobytes(),
    b"abc" * 500,
]


@pytest.mark.parametrize("content", CONTENTS, ids=len)
def test_the_announced_size_is_that_of_the_content(content: bytes) -> None:
    data = liblzfse.compress(content)
    assert raw_size(data) == len(content)
    assert decompress(data, len(content), Path("a"), "depth") == content


@pytest.mark.parametrize("content", CONTENTS, ids=len)
def test_a_stream_that_is_cut_off_anywhere_is_refused(content: bytes) -> None:
    data = liblzfse.compress(content)
    for keep in {0, 3, 4, 8, 11, len(data) // 2, len(data) - 5, len(data) - 1}:
        with pytest.raises(LogError, match=r"a: depth: .*Fix: "):
            decompress(data[:keep], len(content), Path("a"), "depth")


def test_flipped_bytes_raise_an_error_or_return_the_size() -> None:
    content = CONTENTS[4]
    data = bytearray(liblzfse.compress(content))
    for at in RNG.integers(0, len(data), 200).tolist():
        damaged = data.copy()
        damaged[at] ^= 0x55
        with suppress(LogError):
            assert len(decompress(bytes(damaged), len(content), Path("a"), "depth")) == len(content)


def test_a_bomb_is_refused_by_its_announced_size() -> None:
    with pytest.raises(LogError, match="has 50000000 bytes"):
        decompress(liblzfse.compress(bytes(50_000_000)), 1000, Path("a"), "depth")


def test_more_blocks_than_an_encoder_writes_are_refused() -> None:
    stream = struct.pack("<4sI", b"bvx-", 1) + b"x"
    with pytest.raises(LogError, match="in 1000 blocks"):
        decompress(stream * 1000 + b"bvx$", 1000, Path("a"), "depth")


def test_without_the_package_one_sentence_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "liblzfse", None)
    with pytest.raises(LogError, match=r"a: depth: needs the package pyliblzfse\. Fix: .*splatbot\[record3d\]"):
        decompress(b"bvx$", 0, Path("a"), "depth")
