"""Configuration of a run: sections of settings, their layout in YAML files, and where values come from."""

from splatbot.config.load import config_from_yaml, load_config, read_yaml, with_cameras, with_sensor
from splatbot.config.sections import (
    BundleConfig,
    CameraConfig,
    Config,
    LoopsConfig,
    MappingConfig,
    PoseConfig,
    SensorConfig,
    TrackingConfig,
)

__all__ = [
    "BundleConfig",
    "CameraConfig",
    "Config",
    "LoopsConfig",
    "MappingConfig",
    "PoseConfig",
    "SensorConfig",
    "TrackingConfig",
    "config_from_yaml",
    "load_config",
    "read_yaml",
    "with_cameras",
    "with_sensor",
]
