"""`splatbot serve`: a map, or a log while it is being mapped, over HTTP."""

from __future__ import annotations

import logging
from pathlib import Path

from splatbot.errors import InputError
from splatbot.gaussians import GaussianModel, Snapshot
from splatbot.protocols import FrameSource
from splatbot.robots.cameras import is_camera, open_camera
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
    ros_port: int | None = None,
    viewer_port: int | None = None,
    record: Path | None = None,
    config: Path | None = None,
    service_config: Path | None = None,
) -> None:
    """Answer questions about a map over HTTP until Ctrl-C or SIGTERM.

    Examples:
        splatbot serve --map runs/demo/map.ply
        splatbot serve --log recordings/desk --port 8080
        splatbot serve --camera "replay:recordings/desk?loop=1" --viewer-port 8001 --ros-port 9090
        curl localhost:8000/v1/maps/default/distance -H 'content-type: application/json' -d '{"points": [[0, 0, 1]]}'

    Then http://localhost:8000/docs lists every question with examples, and
    http://localhost:8000/v1/maps/default/render shows the map.

    Args:
        map: a map file, or a run folder that holds map.ply.
        log: a log that is mapped while the service runs; the answers follow the map's latest state.
        camera: a camera that is mapped while the service runs (replay:LOG plays a recording in real time); or, with
            --log, intrinsics instead of the log's own.
        host: address to listen on (default 127.0.0.1; 0.0.0.0 for every interface), or SPLATBOT_HOST.
        port: port to listen on (default 8000; 0 takes a free one), or SPLATBOT_PORT.
        ros_port: one more port, for roslib clients that want a port of their own (usually 9090); rosbridge is at
            /rosbridge of --port in any case, Foxglove at /foxglove.
        viewer_port: show the map in the browser at this port, on this machine alone.
        record: record every topic into this MCAP file; what was mapped can be mapped again from it.
        config: YAML file with the configuration of mapping.
        service_config: YAML file with the service's address and limits.
    """
    logging.basicConfig(level=logging.INFO, format="%(levelname)s: %(message)s")
    given = {"host": host, "port": port, "ros_port": ros_port, "viewer_port": viewer_port, "record": record}
    settings = load_settings(service_config, **given)
    live = log is not None or (camera is not None and is_camera(camera))
    if (map is not None) == live or (log is not None and camera is not None and is_camera(camera)):
        hint = "e.g. --map runs/demo/map.ply"
        raise InputError("give a map, a log or a camera.", field="--map, --log, --camera", hint=hint)
    store = MapStore()
    if map is not None:
        path = map / "map.ply" if map.is_dir() else map
        store.add(MAP_ID, source=path.name, state="static", snapshot=Snapshot(GaussianModel.load(path), map_version=1))
        run_service(settings, store, on_start=_announce)
    else:
        _serve_log(store, log, camera, config, settings)


def _serve_log(
    store: MapStore, log: str | None, camera: str | None, config: Path | None, settings: ServiceSettings
) -> None:
    from splatbot.config import load_config
    from splatbot.logs import open_log
    from splatbot.services.live import LiveMapping
    from splatbot.slam import Slam

    source = open_camera(camera or "") if log is None else open_log(log, camera=camera)
    store.add(MAP_ID, source=source.name, state="mapping")
    mapping = LiveMapping(store, MAP_ID, source, Slam(load_config(config)))
    mapping.start()
    try:
        run_service(settings, store, on_start=_announce)
    finally:
        if isinstance(source, FrameSource):
            source.close()  # it may be waiting for a frame
        mapping.stop(timeout_s=settings.shutdown_s)


def _announce(url: str) -> None:
    print(f"serving on {url}  (questions: {url}/docs, a picture: {url}/v1/maps/{MAP_ID}/render)", flush=True)
