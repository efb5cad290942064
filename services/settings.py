"""Settings of the service; YAML < environment (SPLATBOT_HOST, SPLATBOT_PORT, ...) < flags."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Any

import yaml
from pydantic import Field, ValidationError, ValidationInfo, field_validator
from pydantic_settings import (
    BaseSettings,
    NoDecode,
    PydanticBaseSettingsSource,
    SettingsConfigDict,
    SettingsError,
    YamlConfigSettingsSource,
)

from splatbot.errors import ConfigError
from splatbot.services.keys import check_hash

_NAMES = {
    "allowed_hosts": (r"[\w.-]+|[0-9A-Fa-f:]+", "give names without scheme and port, e.g. robot.lan"),
    "cors_origins": (r"\*|null|[a-z][\w+.-]*://[^/?#\s]*", "give scheme://host or scheme://host:port, without a path"),
}

Words = Annotated[tuple[str, ...], NoDecode]
"""Several words: a list in YAML, with commas between them in the environment."""


class ServiceSettings(BaseSettings):
    """Address, keys and limits of the service."""

    model_config = SettingsConfigDict(env_prefix="SPLATBOT_", extra="forbid")

    host: str = Field("127.0.0.1", description="address to listen on; 0.0.0.0 for every interface")
    port: int = Field(8000, ge=0, le=65535, description="port to listen on; 0 takes a free one")
    ros_port: int | None = Field(None, ge=0, le=65535, description="a port for roslib clients too (9090 is theirs)")
    zenoh_router: str | None = Field(None, description="where ROS 2 nodes meet over Zenoh, e.g. tcp/localhost:7447")
    ros_domain: int = Field(0, ge=0, le=232, description="their ROS_DOMAIN_ID")
    viewer_port: int | None = Field(None, ge=0, le=65535, description="port of the viewer, on this machine alone")
    record: Path | None = Field(None, description="an MCAP file that every topic is recorded into")
    api_keys: Words = Field((), description="hashes that `splatbot serve --new-key` prints; needed beyond loopback")
    insecure_no_auth: bool = Field(False, description="on loopback, mapping and moving need no key")
    tls_cert: Path | None = Field(None, description="certificate chain (PEM); with tls_key the service speaks HTTPS")
    tls_key: Path | None = Field(None, description="its private key (PEM)")
    cors_origins: Words = Field((), description="web pages' origins that may ask; none by default")
    allowed_hosts: Words = Field((), description="more names of the service in Host headers")
    trusted_proxies: Words = Field((), description="addresses of proxies whose X-Forwarded-For and -Proto count")
    data_dir: Path | None = Field(None, description="folder of saved maps; without it maps live in memory")
    log_roots: Words = Field((), description="folders whose recordings may be mapped by POST /v1/maps")
    save_every_s: float = Field(30.0, gt=0, description="how often growing maps are saved to data_dir [s]")
    robot: str | None = Field(None, description="robot that is masked in frames of ROS topics, cameras and --log")
    scene: Path | None = Field(None, description="scene.yaml with T_link_camera: the camera on that robot's link")
    arm: str | None = Field(None, description="an arm on the network, e.g. ur:192.168.1.10; its model is `robot`")
    camera_wait_s: float = Field(60.0, ge=0, description="how long a camera that is gone is opened again [s]")
    max_maps: int = Field(256, ge=1, description="maps that are served at once")
    max_client_maps: int = Field(128, ge=1, description="maps that one client makes; more are answered 403")
    max_client_bytes: int = Field(
        16 * 2**30,
        ge=1024,
        description="Gaussians of its maps, and its versions on disk; more are answered 403 [bytes]",
    )
    max_versions: int = Field(32, ge=2, description="saved versions of one map; the oldest without a label make room")
    max_versions_bytes: int = Field(
        20 * 2**30, ge=1024, description="size of all versions in data_dir; the client's oldest make room [bytes]"
    )
    max_merge_gaussians: int = Field(2_000_000, ge=1, description="of both maps of one merge or comparison")
    max_merge_keyframes: int = Field(1000, ge=2, description="of both maps of one merge or comparison")
    max_points: int = Field(100_000, ge=1, description="points in one distance request")
    tiles_mb: float = Field(24, gt=0, description="memory of the tiles of a tiled map, and of its fields [MB]")
    max_configurations: int = Field(10_000, ge=1, description="joint configurations in one request")
    max_views: int = Field(16, ge=1, description="views in one render request")
    max_pixels: int = Field(2_100_000, ge=1, description="pixels of one rendered view, or of one pushed frame")
    max_plan_ms: float = Field(10_000, gt=0, description="longest budget of one planning request [ms]")
    max_frames: int = Field(100_000, ge=1, description="frames of one log that is mapped by POST /v1/maps")
    max_waiting_frames: int = Field(4, ge=1, description="pushed frames of one map that may wait")
    max_body_bytes: int = Field(16 * 2**20, ge=1024, description="size of a request's body [bytes]")
    max_upload_bytes: int = Field(2**30, ge=1024, description="size of an uploaded recording, packed [bytes]")
    max_unpacked_bytes: int = Field(4 * 2**30, ge=1024, description="size of an uploaded recording, unpacked [bytes]")
    max_message_bytes: int = Field(16 * 2**20, ge=1024, description="size of one WebSocket message [bytes]")
    max_requests: int = Field(128, ge=1, description="requests that are open at once; more are answered 503")
    max_waiting: int = Field(64, ge=1, description="requests of one kind that may wait; more are answered 503")
    requests_per_s: float = Field(500.0, gt=0, description="of one client in the long run; more are answered 429")
    max_streams: int = Field(64, ge=1, description="event streams and WebSockets that are open at once")
    max_client_streams: int = Field(32, ge=1, description="of one client")
    max_connections: int = Field(1024, ge=8, description="connections that are open at once")
    max_client_connections: int = Field(256, ge=4, description="of one address; its oldest idle one makes room")
    idle_s: float = Field(10.0, gt=0, description="time within which a request's headers must arrive [s]")
    body_s: float = Field(
        30.0, gt=0, description="time within which its body must arrive, and a client must read on [s]"
    )
    max_jobs: int = Field(16, ge=1, description="jobs that may wait")
    max_client_jobs: int = Field(16, ge=1, description="of one client that wait or run; more are answered 429")
    job_workers: int = Field(2, ge=1, description="jobs that run at once")
    shutdown_s: int = Field(6, ge=0, description="how long running requests may take to end after SIGTERM [s]")
    niceness: int = Field(10, ge=0, le=19, description="of the threads that answer: mapping and arms go first")
    log_json: bool = Field(False, description="one JSON object a line instead of text")

    @field_validator("api_keys", "cors_origins", "allowed_hosts", "trusted_proxies", "log_roots", mode="before")
    @classmethod
    def _split(cls, value: Any) -> Any:
        return tuple(word.strip() for word in value.split(",") if word.strip()) if isinstance(value, str) else value

    @field_validator("api_keys")
    @classmethod
    def _hashed(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        for key in value:
            check_hash(key)
        return value

    @field_validator("allowed_hosts", "cors_origins")
    @classmethod
    def _named(cls, value: tuple[str, ...], info: ValidationInfo) -> tuple[str, ...]:
        form, hint = _NAMES[str(info.field_name)]
        for word in value:
            if not re.fullmatch(form, word):
                raise ValueError(f"{word[:80]!r} never matches; {hint}")
        return value

    @property
    def loopback(self) -> bool:
        """True if only this machine can connect."""
        return self.host in ("localhost", "::1") or self.host.startswith("127.")

    @classmethod
    def settings_customise_sources(
        cls,
        settings_cls: type[BaseSettings],
        init_settings: PydanticBaseSettingsSource,
        env_settings: PydanticBaseSettingsSource,
        dotenv_settings: PydanticBaseSettingsSource,
        file_secret_settings: PydanticBaseSettingsSource,
    ) -> tuple[PydanticBaseSettingsSource, ...]:
        """Order the sources: flags first, then the environment, then the YAML file."""
        return init_settings, env_settings, YamlConfigSettingsSource(settings_cls)


def load_settings(path: str | Path | None = None, **flags: Any) -> ServiceSettings:
    """Load a YAML file, then apply the environment, then the ``flags`` that are not None.

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
