"""Settings of the service: YAML < environment < flags."""

from __future__ import annotations

from pathlib import Path

import pytest

from splatbot.errors import ConfigError
from splatbot.services.settings import load_settings


def _file(folder: Path, text: str) -> Path:
    path = folder / "service.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_flag_beats_the_environment_which_beats_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = _file(tmp_path, "port: 1001\nhost: 10.0.0.1\nmax_points: 7\n")
    monkeypatch.setenv("SPLATBOT_PORT", "1002")
    monkeypatch.setenv("SPLATBOT_HOST", "10.0.0.2")
    settings = load_settings(path, host="10.0.0.3", port=None)
    assert (settings.host, settings.port, settings.max_points) == ("10.0.0.3", 1002, 7)


def test_variables_of_the_mapping_configuration_do_not_disturb(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPLATBOT_MAPPING__MAX_GAUSSIANS", "5000")
    monkeypatch.setenv("SPLATBOT_TEST_DATA", "/somewhere")
    assert load_settings().port == 8000


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("prot: 80\n", "prot"),
        ("port: 700000\n", "port"),
        ("port: [\n", "service.yaml"),
        ("- port\n", "service.yaml"),
    ],
)
def test_a_wrong_file_is_named_with_its_key(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        load_settings(_file(tmp_path, text))


def test_a_missing_file_is_an_error_not_the_defaults(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="does not exist"):
        load_settings(tmp_path / "none.yaml")


def test_a_wrong_variable_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPLATBOT_PORT", "http")
    with pytest.raises(ConfigError, match="port"):
        load_settings()
