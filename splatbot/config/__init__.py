"""Configuration of a run: sections of settings, their layout in YAML files, and where values come from."""

from splatbot.config.load import config_from_yaml, load_config, read_yaml
from splatbot.config.sections import Config, LoopsConfig, MappingConfig, SensorConfig, TrackingConfig

__all__ = [
    "Config",
    "LoopsConfig",
    "MappingConfig",
    "SensorConfig",
    "TrackingConfig",
    "config_from_yaml",
    "load_config",
    "read_yaml",
]
