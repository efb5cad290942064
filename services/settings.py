"""What the service can be told; YAML < environment (SPLATBOT_HOST, SPLATBOT_PORT, ...) < flags."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml
from pydantic import Field, ValidationError
from pydantic_settings import (
    BaseSettings,
    PydanticBaseSettingsSource,
    SettingsConfigDict,
    SettingsError,
    YamlConfigSettingsSource,
)

from splatbot.errors import ConfigError


class ServiceSettings(BaseSettings):
    """Address and limits of the service."""

    model_config = SettingsConfigDict(env_prefix="SPLATBOT_", extra="forbid")

    host: str = Field("127.0.0.1", description="address to listen on; 0.0.0.0 for every interface")
    port: int = Field(8000, ge=0, le=65535, description="port to listen on; 0 takes a free one")
    max_points: int = Field(100_000, ge=1, description="points in one distance request")
    max_body_bytes: int = Field(16 * 2**20, ge=1024, description="size of a request's body [bytes]")
    max_message_bytes: int = Field(32 * 2**20, ge=1024, description="size of one WebSocket message [bytes]")
    max_pixels: int = Field(2_100_000, ge=1, description="pixels of one rendered view")
    shutdown_s: int = Field(10, ge=0, description="how long running requests may take to end after SIGTERM [s]")

    @classmethod
    def settings_customise_sources(
        cls,
        settings_cls: type[BaseSettings],
        init_settings: PydanticBaseSettingsSource,
        env_settings: PydanticBaseSettingsSource,
        dotenv_settings: PydanticBaseSettingsSource,
        file_secret_settings: PydanticBaseSettingsSource,
    ) -> tuple[PydanticBaseSettingsSource, ...]:
        """Flags first, then the environment, then the YAML file."""
        return init_settings, env_settings, YamlConfigSettingsSource(settings_cls)


def load_settings(path: str | Path | None = None, **flags: Any) -> ServiceSettings:
    """The settings of a YAML file, then the environment, then the ``flags`` that are not None; the later wins.

    Raises:
        ConfigError: the file is missing or is no YAML mapping, a key is unknown or a value out of range.
    """
    if path is not None and not Path(path).is_file():
        raise ConfigError("does not exist.", file=path, hint="check the path")

    class _Settings(ServiceSettings):
        model_config = SettingsConfigDict(yaml_file=path)

    try:
        return _Settings(**{name: value for name, value in flags.items() if value is not None})
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        names = ", ".join(ServiceSettings.model_fields)
        raise ConfigError(f"{first['msg']}.", file=path, field=key, hint=f"the settings are {names}") from error
    except (SettingsError, yaml.YAMLError, UnicodeDecodeError, TypeError, ValueError) as error:
        raise ConfigError(f"is no mapping of settings ({error}).", file=path, hint="write `name: value`") from error
