"""Configuration: file < environment < overrides; unknown keys and wrong values are named."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from splatbot.config import Config, load_config
from splatbot.errors import ConfigError


def write(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "config.yaml"
    path.write_text(text)
    return path


def test_the_later_source_wins(tmp_path: Path) -> None:
    path = write(tmp_path, "mapping: {max_gaussians: 1000, refine_iterations: 3}\nseed: 5\n")
    environ = {"SPLATBOT_MAPPING__MAX_GAUSSIANS": "2000", "SPLATBOT_SEED": "6", "SPLATBOT_TEST_DATA": "/x", "HOME": "/"}
    config = load_config(path, environ=environ, overrides={"seed": 7})
    assert (config.mapping.refine_iterations, config.mapping.max_gaussians, config.seed) == (3, 2000, 7)


def test_without_anything_the_defaults_hold(tmp_path: Path) -> None:
    assert load_config(environ={}) == Config()
    assert load_config(write(tmp_path, ""), environ={}) == Config()


def test_a_dumped_configuration_reads_back(tmp_path: Path) -> None:
    config = load_config(environ={}, overrides={"mapping.max_gaussians": 1234, "seed": 9})
    assert load_config(write(tmp_path, config.to_yaml()), environ={}) == config


@pytest.mark.parametrize(
    ("overrides", "field"),
    [
        ({"mapping.max_gausians": 5}, "mapping.max_gausians"),
        ({"speed": 5}, "speed"),
        ({"mapping.max_gaussians": -1}, "mapping.max_gaussians"),
        ({"mapping.max_gaussians": "many"}, "mapping.max_gaussians"),
        ({"seed.value": 1}, "seed"),
    ],
)
def test_a_wrong_key_or_value_is_named(overrides: dict[str, Any], field: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_config(environ={}, overrides=overrides)
    assert caught.value.field == field


@pytest.mark.parametrize("text", ["[1, 2]", "a: b: c", "seven"])
def test_a_file_that_is_no_mapping_is_named(tmp_path: Path, text: str) -> None:
    path = write(tmp_path, text)
    with pytest.raises(ConfigError) as caught:
        load_config(path, environ={})
    assert caught.value.file == str(path)
    assert caught.value.hint


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="No such file"):
        load_config(tmp_path / "none.yaml", environ={})
