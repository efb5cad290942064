"""Loading of the configuration: YAML < environment (``SPLATBOT_*``) < flags; an unknown key is an error."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml
from pydantic import ValidationError

from splatbot.config.layout import from_layout, known_sections, path_of
from splatbot.config.sections import Config
from splatbot.errors import ConfigError

_ENV_PREFIX = "SPLATBOT_"


def load_config(
    path: str | Path | None = None,
    *,
    overrides: Mapping[str, Any] | None = None,
    environ: Mapping[str, str] | None = None,
) -> Config:
    """Load a YAML file, apply the environment, then ``overrides``.

    Keys of earlier versions still load, with a :class:`splatbot.errors.DeprecatedNameWarning`.

    Args:
        path: YAML file. If None, the defaults are the start.
        overrides: dotted keys, as in ``{"mapping.max_gaussians": 50_000, "expert.tracking.n_pixels": 2400}``.
        environ: variables such as ``SPLATBOT_MAPPING__MAX_GAUSSIANS``. If None, the process's environment is read.

    Raises:
        ConfigError: a file is missing or is no YAML mapping, a key is unknown, or a value is out of range.
    """
    values: dict[str, Any] = read_yaml(Path(path)) if path is not None else {}
    given: dict[str, Any] = {}
    for name, text in (os.environ if environ is None else environ).items():
        keys = name.removeprefix(_ENV_PREFIX).lower().split("__")
        if name.startswith(_ENV_PREFIX) and keys[0] in known_sections():
            _assign(given, keys, yaml.safe_load(text))
    for dotted, value in (overrides or {}).items():
        _assign(given, dotted.split("."), value)
    return validate(_merged(from_layout(values), from_layout(given)), file=path)


def config_from_yaml(text: str) -> Config:
    """Return the configuration that :meth:`Config.to_yaml` of this or an earlier version wrote.

    Raises:
        ConfigError: a key is unknown, or a value is out of range.
    """
    return validate(from_layout(yaml.safe_load(text) or {}))


def with_sensor(config: Config, values: Mapping[str, Any], *, file: str | None = None) -> Config:
    """Return a configuration with the values of a calibrated sensor for the keys of ``sensor:`` that it does not set.

    Args:
        config: configuration.
        values: values by key, such as those of a camera file.
        file: camera file, for error messages.

    Raises:
        ConfigError: a key is unknown, or a value is out of range.
    """
    given = config.sensor.model_dump(include=config.sensor.model_fields_set)
    sensor = validate({"sensor": {**values, **given}}, file=file).sensor
    tracking = config.tracking.model_copy()
    tracking.__dict__["sensor"] = sensor
    return config.model_copy(update={"sensor": sensor, "tracking": tracking})


def with_cameras(config: Config, cameras: Mapping[str, Mapping[str, Any]], *, file: str | None = None) -> Config:
    """Return a configuration with the further cameras of a log that it does not describe itself.

    Args:
        config: configuration.
        cameras: values of :class:`splatbot.config.CameraConfig` by name.
        file: file of the log, for error messages.

    Raises:
        ConfigError: a key is unknown, or a value is out of range.
    """
    known = {name: values for name, values in cameras.items() if name not in config.cameras}
    added = validate({"cameras": known}, file=file).cameras
    return config.model_copy(update={"cameras": {**config.cameras, **added}})


def validate(values: dict[str, Any], *, file: str | Path | None = None) -> Config:
    """Return the configuration of values in the layout of :class:`Config`.

    Raises:
        ConfigError: names the first wrong key as files spell it.
    """
    try:
        return Config.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
        location = [str(part) for part in first["loc"]]
        key = path_of(*location) if len(location) == 2 else ".".join(location)
        hint = "`splatbot map --dump-config` prints all keys and values"
        raise ConfigError(f"{first['msg']}.", file=file, field=key, hint=hint) from error


def read_yaml(path: Path) -> dict[str, Any]:
    """Return the mapping that a YAML file holds; an empty file gives {}.

    Raises:
        ConfigError: the file cannot be read, or is not a YAML mapping.
    """
    try:
        values = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"cannot be read ({error.strerror}).", file=path, hint="check the path") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(
            f"is not YAML: {error}.", file=path, hint="correct the line that the message names"
        ) from error
    if values is None:
        return {}
    if not isinstance(values, dict):
        raise ConfigError("is not a mapping of sections.", file=path, hint="write `section: {key: value}`")
    return values


def _merged(base: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    """Return ``base`` with the keys of ``over``; sections are merged key by key."""
    out = dict(base)
    for name, value in over.items():
        old = out.get(name)
        out[name] = old | value if isinstance(old, dict) and isinstance(value, dict) else value
    return out


def _assign(values: dict[str, Any], keys: list[str], value: Any) -> None:
    for key in keys[:-1]:
        values = values.setdefault(key, {})
        if not isinstance(values, dict):
            raise ConfigError(f"{key} is not a section.", field=".".join(keys))
    values[keys[-1]] = value
