"""`splatbot bench logs` in its quick form: each layout is read whole."""

from __future__ import annotations

from pathlib import Path

import pytest

from splatbot.bench.logs import BENCHMARK, LogsSettings
from splatbot.errors import InputError


def test_each_layout_has_a_rate_and_opencv_alone_is_the_peer(tmp_path: Path) -> None:
    results = BENCHMARK.run(LogsSettings(out=tmp_path, quick=True))
    rows = [(row.case, row.peer) for row in results.rows]
    size = "160x120"
    assert rows == [
        (f"{size}, TUM, PNG and PNG", None),
        (f"{size}, MCAP, zstd", None),
        (f"{size}, MCAP, raw", None),
        (f"{size}, TUM, PNG and PNG", "cv2.imread"),
    ]
    assert all(row.value is not None and row.value > 1.0 for row in results.rows)
    assert (tmp_path / "logs.json").is_file()


def test_a_single_frame_has_no_rate() -> None:
    with pytest.raises(InputError, match="--frames"):
        LogsSettings(frames=1).validate()
