"""`splatbot serve`: a map, or a log while it is being mapped, over HTTP."""

from __future__ import annotations

import logging
from pathlib import Path

from splatbot.errors import InputError
from splatbot.gaussians import GaussianModel, Snapshot
from splatbot.services.server import run_service
from splatbot.services.settings import ServiceSettings, load_settings
from splatbot.services.store import MapStore

MAP_ID = "default"


def serve(
    *,
    map: Path | None = None,
    log: str | None = None,
    camera: str | None = None,
    host: str | None = None,
    port: int | None = None,
    config: Path | None = None,
    service_config: Path | None = None,
) -> None:
    """Answer questions about a map over HTTP until Ctrl-C or SIGTERM.

    Examples:
        splatbot serve --map runs/demo/map.ply
        splatbot serve --log recordings/desk --port 8080
        curl localhost:8000/v1/maps/default/distance -H 'content-type: application/json' -d '{"points": [[0, 0, 1]]}'

    Then http://localhost:8000/docs lists every question with examples, and
    http://localhost:8000/v1/maps/default/render shows the map.

    Args:
        map: a map file, or a run folder that holds map.ply.
        log: a log that is mapped while the service runs; the answers follow the map's latest state.
        camera: intrinsics of the log, instead of its own (as for `splatbot map`).
        host: address to listen on (default 127.0.0.1; 0.0.0.0 for every interface), or SPLATBOT_HOST.
        port: port to listen on (default 8000; 0 takes a free one), or SPLATBOT_PORT.
        config: YAML file with the configuration of mapping.
        service_config: YAML file with the service's address and limits.
    """
    logging.basicConfig(level=logging.INFO, format="%(levelname)s: %(message)s")
    settings = load_settings(service_config, host=host, port=port)
    if (map is None) == (log is None):
        raise InputError("give either a map or a log.", field="--map, --log", hint="e.g. --map runs/demo/map.ply")
    store = MapStore()
    if map is not None:
        path = map / "map.ply" if map.is_dir() else map
        store.add(MAP_ID, source=path.name, state="static", snapshot=Snapshot(GaussianModel.load(path), map_version=1))
        run_service(settings, store, on_start=_announce)
    elif log is not None:
        _serve_log(store, log, camera, config, settings)


def _serve_log(store: MapStore, uri: str, camera: str | None, config: Path | None, settings: ServiceSettings) -> None:
    from splatbot.config import load_config
    from splatbot.logs import open_log
    from splatbot.services.live import LiveMapping
    from splatbot.slam import Slam

    source = open_log(uri, camera=camera)
    store.add(MAP_ID, source=source.name, state="mapping")
    mapping = LiveMapping(store, MAP_ID, source, Slam(load_config(config)))
    mapping.start()
    try:
        run_service(settings, store, on_start=_announce)
    finally:
        mapping.stop(timeout_s=settings.shutdown_s)


def _announce(url: str) -> None:
    print(f"serving on {url}  (questions: {url}/docs, a picture: {url}/v1/maps/{MAP_ID}/render)", flush=True)
