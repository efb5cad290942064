"""Checks that the readers of maps share: of sizes before memory is allocated, and of decoded values."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatbot.checksums import check_file
from splatbot.errors import FormatError
from splatbot.gaussians.model import OPACITY_MAX, OPACITY_MIN, SCALE_MIN

Table = NDArray[np.float32]

MAX_GAUSSIANS = 50_000_000
"""The largest count that a header may claim; a map of it takes 3 GB in memory."""

MAX_EXPANSION = 64
"""Decoded bytes for each stored byte beyond which a file is refused; real files stay below 8."""

_UNPROVEN_BYTES = 64 * 2**20  # decoded size that needs no proof by the size of the file

_AGAIN = "copy or export the file again"
_log = logging.getLogger(__name__)


def read_bytes(path: str | Path) -> bytes:
    """Read a whole file, and check it against the checksums of its folder if there are any.

    Raises:
        FormatError: it cannot be read, or its checksum does not fit.
    """
    check_file(path)
    try:
        return Path(path).read_bytes()
    except OSError as error:
        raise FormatError(f"cannot be read ({error.strerror}).", file=path, hint="give a map file") from error


def check_count(path: str | Path, count: int, field: str) -> None:
    """Check a number of Gaussians that a header claims.

    Raises:
        FormatError: it is below 1 or above :data:`MAX_GAUSSIANS`.
    """
    if count < 1:
        raise FormatError(f"has {count} Gaussians.", file=path, field=field, hint=_AGAIN)
    if count > MAX_GAUSSIANS:
        hint = f"split the scene; at most {MAX_GAUSSIANS:,} are read"
        raise FormatError(f"claims {count:,} Gaussians.", file=path, field=field, hint=hint)


def check_expansion(path: str | Path, decoded: int, stored: int, field: str) -> None:
    """Check the size that compressed data claims to decode to.

    Args:
        decoded: claimed bytes.
        stored: bytes of the file.

    Raises:
        FormatError: ``decoded`` is out of proportion to ``stored``, as in a decompression bomb.
    """
    if decoded > max(_UNPROVEN_BYTES, MAX_EXPANSION * stored):
        raise FormatError(f"claims {decoded:,} bytes in {stored:,}.", file=path, field=field, hint=_AGAIN)


def damaged(path: str | Path, field: str, reason: object) -> FormatError:
    """Return the error of a damaged or truncated file."""
    return FormatError(f"is damaged or truncated ({reason}).", file=path, field=field, hint=_AGAIN)


def replace_degenerate(path: str | Path, opacity: Table, log_scales: Table, quats: Table) -> None:
    """Replace degenerate values with a clear meaning in place: zero quaternions, zero scales, infinite opacities.

    Each replacement logs a warning.
    """
    zero = ~quats.any(axis=1)
    flat = np.isneginf(log_scales)
    sure = np.isinf(opacity)
    quats[zero] = (1.0, 0.0, 0.0, 0.0)
    log_scales[flat] = np.log(SCALE_MIN)
    bound = np.log(OPACITY_MAX / (1.0 - OPACITY_MAX)), np.log(OPACITY_MIN / (1.0 - OPACITY_MIN))
    opacity[sure] = np.where(opacity[sure] > 0, *bound)
    for count, replacement in (
        (zero.sum(), "zero quaternions became the identity"),
        (flat.sum(), f"scales of 0 became {SCALE_MIN} m"),
        (sure.sum(), "infinite opacities became the nearest finite ones"),
    ):
        if count:
            _log.warning("%s: %d %s", path, count, replacement)


def check_finite(path: str | Path, table: Table, names: list[str]) -> None:
    """Check the values of a table (N, len(names)).

    Raises:
        FormatError: a value is NaN or infinite.
    """
    finite = np.isfinite(table)
    if finite.all():
        return
    bad = ~finite.all(axis=1)
    row = int(np.argmax(bad))
    raise FormatError(
        f"{int(bad.sum())} of {len(table)} rows hold NaN or infinity, the first is row {row}.",
        file=path,
        field=names[int(np.argmin(finite[row]))],
        hint="remove those rows, or export the map again",
    )
