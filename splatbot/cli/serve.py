"""`splatbot serve`: a map, or a log while it is being mapped, over HTTP."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from splatbot.services.runtime import Runtime

MAP_ID = "default"


def serve(
    *,
    map: Path | None = None,
    log: str | None = None,
    data: Path | None = None,
    camera: str | None = None,
    host: str | None = None,
    port: int | None = None,
    config: Path | None = None,
    service_config: Path | None = None,
    new_key: bool = False,
) -> int:
    """Answer questions about maps over HTTP until Ctrl-C or SIGTERM.

    Examples:
        splatbot serve --map runs/demo/map.ply
        splatbot serve --log recordings/desk --port 8080
        SPLATBOT_LOG_ROOTS=recordings splatbot serve --data maps
        splatbot serve --new-key
        curl localhost:8000/v1/maps/default/distance -H 'content-type: application/json' -d '{"points": [[0, 0, 1]]}'

    Then http://localhost:8000/docs lists every question with examples, and
    http://localhost:8000/v1/maps/default/render shows the map. Every setting is a variable SPLATBOT_NAME, too.

    Args:
        map: a map file, or a run folder that holds map.ply.
        log: a log that is mapped while the service runs; the answers follow the map's latest state.
        data: folder that maps made by clients are kept in and served from again, or SPLATBOT_DATA_DIR.
        camera: intrinsics of the log, instead of its own (as for `splatbot map`).
        host: address to listen on (default 127.0.0.1; 0.0.0.0 for every interface, which needs keys), or SPLATBOT_HOST.
        port: port to listen on (default 8000; 0 takes a free one), or SPLATBOT_PORT.
        config: YAML file with the configuration of mapping.
        service_config: YAML file with the service's address, keys and limits.
        new_key: print a new API key and its hash for SPLATBOT_API_KEYS, and leave.
    """
    from splatbot.errors import InputError

    if new_key:
        return _print_new_key()
    from splatbot.config import load_config
    from splatbot.services.requests import configure_logging
    from splatbot.services.runtime import Runtime, check_exposure
    from splatbot.services.server import run_service
    from splatbot.services.settings import load_settings

    settings = load_settings(service_config, host=host, port=port, data_dir=data)
    configure_logging(as_json=settings.log_json)
    if (map is None) == (log is None) and (map is not None or settings.data_dir is None):
        hint = "e.g. --map runs/demo/map.ply; or --data DIR, for maps that clients make"
        raise InputError("give either a map or a log.", field="--map, --log", hint=hint)
    check_exposure(settings)
    runtime = Runtime(settings, config=load_config(config))
    if map is not None:
        _add_map(runtime, map)
    elif log is not None:
        _follow_log(runtime, log, camera)
    try:
        run_service(runtime, on_start=_announce)
    finally:
        runtime.close()
    return 0


def _add_map(runtime: Runtime, map_: Path) -> None:
    from splatbot.gaussians import GaussianModel, Snapshot
    from splatbot.workspace import find_workspace

    path = map_ / "map.ply" if map_.is_dir() else map_
    snapshot = Snapshot(GaussianModel.load(path), map_version=1)
    runtime.store.add(MAP_ID, source=path.name, state="static", snapshot=snapshot, workspace=find_workspace(path))


def _follow_log(runtime: Runtime, uri: str, camera: str | None) -> None:
    from splatbot.logs import open_log
    from splatbot.services.mapping import workspace_of
    from splatbot.slam import Slam

    source = open_log(uri, camera=camera)
    runtime.store.add(MAP_ID, source=source.name, state="mapping", workspace=workspace_of(source.uri, None))
    runtime.follow(MAP_ID, source, Slam(runtime.config))


def _print_new_key() -> int:
    from splatbot.services.keys import hash_key, new_key

    key = new_key()
    print(f"key (for clients; shown once): {key}")
    print(f"hash (for the service):        SPLATBOT_API_KEYS={hash_key(key)}")
    return 0


def _announce(url: str) -> None:
    print(f"serving on {url}  (questions: {url}/docs, a picture: {url}/v1/maps/{MAP_ID}/render)", flush=True)
