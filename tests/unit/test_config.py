"""Configuration: file < environment < overrides; unknown keys and wrong values are named."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import pytest
import yaml

from splatbot.config import Config, TrackingConfig, load_config
from splatbot.errors import ConfigError, DeprecatedNameWarning


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


def test_expert_keys_stand_under_expert_and_are_attributes_of_their_section(tmp_path: Path) -> None:
    path = write(tmp_path, "tracking: {budget_ms: 30}\nexpert: {tracking: {n_levels: 2}, mapping: {thickness: 0.5}}\n")
    config = load_config(path, environ={"SPLATBOT_EXPERT__TRACKING__N_PIXELS": "777"})
    assert (config.tracking.budget_ms, config.tracking.n_levels, config.tracking.n_pixels) == (30, 2, 777)
    assert config.mapping.thickness == 0.5


def test_about_twenty_keys_are_public() -> None:
    public = yaml.safe_load(Config().to_yaml())
    public.pop("expert")
    assert sum(len(keys) if isinstance(keys, dict) else 1 for keys in public.values()) <= 20


def test_tracking_shares_the_section_of_the_sensor() -> None:
    config = load_config(environ={}, overrides={"sensor.max_depth": 3.5})
    assert config.tracking.sensor is config.sensor
    own = TrackingConfig(n_levels=2)
    assert Config(tracking=own).tracking.n_levels == 2
    assert Config(tracking=own) == Config.model_validate(Config(tracking=own).model_dump())


OLD = """
tracking: {max_depth: 4.0, gate: 0.1, depth_doubt: 3.0, n_levels: 2, wide: never, min_valid: 0.1}
mapping: {new_depth: 0.02, settle: 2.0, still: 0.1, look_every: 0.5, rate_means: 0.001, stride: 4}
loops: {max_strain: 5.0}
"""


def test_a_file_of_an_earlier_version_loads_with_one_warning_that_gives_the_present_names(tmp_path: Path) -> None:
    with pytest.warns(DeprecatedNameWarning) as warned:
        config = load_config(write(tmp_path, OLD), environ={})
    assert len(warned) == 1
    for name in ("expert.sensor.max_depth_difference", "sensor.max_depth", "expert.mapping.means_lr"):
        assert name in str(warned[0].message)
    assert (config.sensor.max_depth, config.sensor.max_depth_difference, config.sensor.depth_sigma_scale) == (4, 0.1, 3)
    assert (config.tracking.n_levels, config.tracking.gicp, config.tracking.min_depth_coverage) == (2, "never", 0.1)
    mapping = config.mapping
    assert (mapping.surface_depth_tolerance, mapping.dynamic_timeout_s, mapping.still_joint_speed) == (0.02, 2.0, 0.1)
    assert (mapping.observe_interval_s, mapping.means_lr, mapping.stride) == (0.5, 0.001, 4)
    assert config.loops.max_edge_sigma == 5.0


def test_present_names_do_not_warn(tmp_path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert load_config(write(tmp_path, Config().to_yaml()), environ={}) == Config()


@pytest.mark.parametrize(
    ("text", "field"),
    [
        ("expert: {mapping: {stride: 2}}", "expert.mapping.stride"),
        ("expert: {speed: {fast: 2}}", "expert.speed.fast"),
        ("expert: {tracking: {n_level: 2}}", "tracking.n_level"),
        ("expert: {tracking: {n_levels: 20}}", "expert.tracking.n_levels"),
        ("expert: 3", "expert"),
        ("expert: {tracking: 3}", "expert.tracking"),
        ("tracking: {gate: 0.1}\nexpert: {sensor: {max_depth_difference: 0.1}}", "expert.sensor.max_depth_difference"),
        ("tracking: {sensor: {max_depth: 1.0}}", "tracking.sensor"),
    ],
)
@pytest.mark.filterwarnings("ignore::splatbot.errors.DeprecatedNameWarning")
def test_a_wrong_expert_key_is_named(tmp_path: Path, text: str, field: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_config(write(tmp_path, text), environ={})
    assert caught.value.field == field


def test_the_warning_about_many_old_keys_is_short_and_says_how_to_convert_them(tmp_path: Path) -> None:
    old = "\n".join(f"  {key}: {value}" for key, value in TrackingConfig().model_dump().items() if key != "budget_ms")
    with pytest.warns(DeprecatedNameWarning, match="more. .*--dump-config") as warned:
        load_config(write(tmp_path, f"tracking:\n{old}\n"), environ={})
    assert len(str(warned[0].message)) < 1500
