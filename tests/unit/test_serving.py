"""The service as a process of its own."""

from __future__ import annotations

from pathlib import Path

import pytest

from splatbot.errors import SplatbotError
from splatbot.serving import serving


def test_a_module_in_the_current_folder_does_not_run_as_the_service(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "splatbot.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')\n")
    monkeypatch.chdir(tmp_path)
    with (
        pytest.raises(SplatbotError, match="did not start"),  # it prints its options, and ends
        serving("--help", log=tmp_path / "log"),
    ):
        pass
    assert not (tmp_path / "ran").exists()
    assert not (tmp_path / "log").read_text()
