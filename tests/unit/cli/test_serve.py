"""`splatbot serve` before it serves."""

from __future__ import annotations

import re

import pytest

from splatbot.cli import main
from splatbot.services.keys import hash_key


def test_a_new_key_is_printed_with_the_hash_that_the_service_keeps(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["serve", "--new-key"]) == 0
    out = capsys.readouterr().out
    key, kept = re.search(r"spb_\S+", out), re.search(r"SPLATBOT_API_KEYS=(\S+)", out)
    assert key
    assert kept
    assert hash_key(key[0]) == kept[1]


def test_beyond_loopback_there_must_be_a_key(capsys: pytest.CaptureFixture[str], tmp_path: object) -> None:
    assert main(["serve", "--data", str(tmp_path), "--host", "0.0.0.0"]) == 2
    assert "--new-key" in capsys.readouterr().err
