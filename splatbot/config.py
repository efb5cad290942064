"""What a run can be told, in sections; YAML < environment (SPLATBOT_*) < flags; unknown keys are errors."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from splatbot.errors import ConfigError

_ENV_PREFIX = "SPLATBOT_"


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid")


class TrackingConfig(_Section):
    """Camera tracking."""

    min_depth: float = Field(0.2, gt=0, description="nearer depth is ignored: a gripper, or below the sensor's range [m]")
    max_depth: float = Field(6.0, gt=0, description="farther depth is ignored [m]")
    max_width: int = Field(640, ge=64, description="finest width used for alignment [px]")
    n_levels: int = Field(3, ge=1, le=6, description="levels of the pyramid")
    n_pixels: int = Field(4800, ge=100, description="pixels per pyramid level in direct alignment: accuracy for time")
    n_features: int = Field(2000, ge=100, description="ORB keypoints per frame")


class MappingConfig(_Section):
    """Fusion into Gaussians."""

    max_gaussians: int = Field(150_000, ge=100, description="hard cap on the map's size")
    refine_iterations: int = Field(8, ge=0, description="optimiser steps per keyframe: accuracy for time")
    holdout_every: int = Field(8, ge=0, description="every n-th frame is tracked, not mapped, and scored; 0: none")


class Config(_Section):
    """Everything a run can be told."""

    tracking: TrackingConfig = Field(default_factory=lambda: TrackingConfig())
    mapping: MappingConfig = Field(default_factory=lambda: MappingConfig())
    seed: int = Field(0, description="seed of every random choice")

    def to_yaml(self) -> str:
        """The configuration in force, as YAML that :func:`load_config` reads back."""
        return yaml.safe_dump(self.model_dump(mode="json"), sort_keys=False)


def load_config(
    path: str | Path | None = None,
    *,
    overrides: Mapping[str, Any] | None = None,
    environ: Mapping[str, str] | None = None,
) -> Config:
    """The configuration of a YAML file, then the environment, then ``overrides``; the later wins.

    Args:
        path: YAML file; None starts from the defaults.
        overrides: dotted keys, as in ``{"mapping.max_gaussians": 50_000}``.
        environ: variables such as ``SPLATBOT_MAPPING__MAX_GAUSSIANS``; None reads the process's own.

    Raises:
        ConfigError: a file is missing or is no YAML mapping, or a key is unknown or a value out of range.
    """
    values: dict[str, Any] = _read_yaml(Path(path)) if path is not None else {}
    for name, text in (os.environ if environ is None else environ).items():
        keys = name.removeprefix(_ENV_PREFIX).lower().split("__")
        if name.startswith(_ENV_PREFIX) and keys[0] in Config.model_fields:
            _assign(values, keys, yaml.safe_load(text))
    for dotted, value in (overrides or {}).items():
        _assign(values, dotted.split("."), value)
    try:
        return Config.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        raise ConfigError(
            f"{first['msg']}.", file=path, field=key, hint="`splatbot map --dump-config` prints all keys and values"
        ) from error


def _read_yaml(path: Path) -> dict[str, Any]:
    try:
        values = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"cannot be read ({error.strerror}).", file=path, hint="check the path") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(f"is not YAML: {error}.", file=path, hint="mend the line it names") from error
    if values is None:
        return {}
    if not isinstance(values, dict):
        raise ConfigError("is not a mapping of sections.", file=path, hint="write `section: {key: value}`")
    return values


def _assign(values: dict[str, Any], keys: list[str], value: Any) -> None:
    for key in keys[:-1]:
        values = values.setdefault(key, {})
        if not isinstance(values, dict):
            raise ConfigError(f"{key} is not a section.", field=".".join(keys))
    values[keys[-1]] = value
