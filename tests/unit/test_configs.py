"""Every shipped configuration file loads and matches its description."""

from __future__ import annotations

from importlib.resources import as_file, files
from pathlib import Path

import pytest
import yaml

from splatbot.config import Config, load_config
from splatbot.services.settings import ServiceSettings, load_settings

CONFIGS = Path(__file__).parents[2] / "configs"
SERVICE = "service.yaml"
RUNS = sorted(path.name for path in CONFIGS.glob("*.yaml") if path.name != SERVICE)


@pytest.mark.parametrize("name", RUNS)
def test_a_run_configuration_loads(name: str) -> None:
    with as_file(files("splatbot.configs") / name) as path:
        assert isinstance(load_config(path, environ={}), Config)


def test_there_are_configurations_for_the_layouts_of_logs() -> None:
    assert {"default.yaml", "tum.yaml", "replica.yaml"} <= set(RUNS)


def test_default_yaml_is_the_defaults_in_full() -> None:
    text = (CONFIGS / "default.yaml").read_text(encoding="utf-8")
    hint = "write it again: splatbot map LOG --dump-config > configs/default.yaml"
    assert text == Config().to_yaml(), hint


def test_service_yaml_is_the_service_defaults_in_full(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ServiceSettings.model_fields:
        monkeypatch.delenv(f"SPLATBOT_{name.upper()}", raising=False)
    text = (CONFIGS / SERVICE).read_text(encoding="utf-8")
    assert yaml.safe_load(text) == ServiceSettings().model_dump(mode="json")
    assert load_settings(CONFIGS / SERVICE).model_dump() == ServiceSettings().model_dump()
