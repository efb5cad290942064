"""`splatbot serve`: a map, or a log while it is being mapped, over HTTP."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from splatbot.cli.paths import check_camera, check_file, check_output
from splatbot.cli.placing import named_robot
from splatbot.errors import InputError
from splatbot.layouts import REPLAY, is_camera, is_tiled_map, log_kind, map_file

if TYPE_CHECKING:
    from splatbot.robots.controllers.ros import RosController
    from splatbot.robots.controllers.ur import UrController
    from splatbot.services.runtime import Runtime
    from splatbot.services.settings import ServiceSettings

MAP_ID = "default"


def serve(
    *,
    map: Annotated[Path | None, tyro.conf.arg(metavar="RUN|MAP")] = None,
    log: Annotated[str | None, tyro.conf.arg(metavar="LOG")] = None,
    data: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None,
    camera: Annotated[str | None, tyro.conf.arg(metavar="PRESET|FILE|CAMERA")] = None,
    host: Annotated[str | None, tyro.conf.arg(metavar="ADDRESS")] = None,
    port: Annotated[int | None, tyro.conf.arg(metavar="PORT")] = None,
    ros_port: Annotated[int | None, tyro.conf.arg(metavar="PORT")] = None,
    viewer_port: Annotated[int | None, tyro.conf.arg(metavar="PORT")] = None,
    record: Annotated[Path | None, tyro.conf.arg(metavar="MCAP")] = None,
    robot: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None,
    scene: Annotated[Path | None, tyro.conf.arg(metavar="YAML")] = None,
    arm: Annotated[str | None, tyro.conf.arg(metavar="ADDRESS")] = None,
    config: Annotated[Path | None, tyro.conf.arg(metavar="YAML")] = None,
    service_config: Annotated[Path | None, tyro.conf.arg(metavar="YAML")] = None,
    insecure_no_auth: bool = False,
    new_key: bool = False,
    scopes: Annotated[str | None, tyro.conf.arg(metavar="SCOPES")] = None,
) -> int:
    """Serve maps over HTTP until Ctrl-C or SIGTERM.

    Examples:
        splatbot serve --map runs/demo/map.ply
        splatbot serve --log recordings/desk --port 8080
        splatbot serve --log recordings/wrist --robot panda
        splatbot serve --log rig.yaml
        splatbot serve --camera "replay:recordings/desk?loop=1" --viewer-port 8001 --ros-port 9090
        SPLATBOT_LOG_ROOTS=recordings splatbot serve --data maps
        splatbot serve --map runs/desk --robot ur5e --arm ur:192.168.1.10
        splatbot serve --new-key --scopes read,move
        curl localhost:8000/v1/maps/default/distance -H 'content-type: application/json' -d '{"points": [[0, 0, 1]]}'

    http://localhost:8000/docs lists every route with examples, and
    http://localhost:8000/v1/maps/default/render shows the map. Every setting is a variable SPLATBOT_NAME, too.

    Args:
        map: a map file, a run folder that holds map.ply, or a tiled map (views, distances and collisions alone).
        log: a log that is mapped while the service runs; the answers follow the map's latest state.
        data: folder that maps made by clients are kept in and served from again, or SPLATBOT_DATA_DIR.
        camera: a camera that is mapped while the service runs (replay:LOG plays a recording in real time); or, with
            --log, intrinsics instead of the log's own.
        host: address to listen on (default 127.0.0.1; 0.0.0.0 for every interface, which needs keys), or SPLATBOT_HOST.
        port: port to listen on (default 8000; 0 takes a free one), or SPLATBOT_PORT.
        ros_port: additional port for roslib clients that need a separate one (usually 9090). rosbridge is always at
            /rosbridge of --port, Foxglove at /foxglove.
        viewer_port: show the map in the browser at this port, on this machine alone. The page needs a key.
        robot: mask this robot in the frames of --log, of a camera and of ROS topics, or SPLATBOT_ROBOT. A frame
            without joint states or TF at its time is not mapped.
        scene: scene.yaml with T_link_camera, the camera on the robot's link, and joint_delay; by default that of the
            log's folder.
        arm: an arm on the network, the arm "real" of the service; --robot is its model (docs/guide/arms.md).
            ros:ws://HOST:9090/ACTION for ros2_control, ur:HOST for Universal Robots; or SPLATBOT_ARM.
        record: record every topic into this MCAP file, from which the frames can be mapped again.
        config: YAML file with the configuration of mapping.
        service_config: YAML file with the service's address, keys and limits.
        insecure_no_auth: on loopback, let clients map and move without a key.
        new_key: print a new API key and its hash for SPLATBOT_API_KEYS, and leave.
        scopes: scopes of the new key, separated by commas: read, map, move (these by default) and admin, which may
            preempt the owner of a moving arm.
    """
    if new_key:
        return _print_new_key(scopes)
    if scopes is not None:
        raise InputError("is for a new key.", field="--scopes", hint="give --new-key, too")
    if map is not None and not is_tiled_map(map):
        map_file(map)
    if log is not None:
        log_kind(log)
        check_camera(camera)
    check_file(config, "--config")
    check_file(service_config, "--service-config")
    check_file(scene, "--scene")
    check_output(data, "--data")
    check_output(record, "--record", folder=False)
    if robot is not None:
        named_robot(robot)

    from splatbot.config import load_config
    from splatbot.services.requests import configure_logging
    from splatbot.services.runtime import Runtime, check_exposure
    from splatbot.services.server import run_service
    from splatbot.services.settings import load_settings

    given = {"host": host, "port": port, "ros_port": ros_port, "viewer_port": viewer_port, "record": record}
    given |= {"robot": robot, "scene": scene, "arm": arm}
    given["insecure_no_auth"] = insecure_no_auth or None
    settings = load_settings(service_config, data_dir=data, **given)
    configure_logging(as_json=settings.log_json)
    device = camera if camera is not None and is_camera(camera) else None
    sources = sum(source is not None for source in (map, log, device))
    if sources > 1 or (sources == 0 and settings.data_dir is None):
        hint = "e.g. --map runs/demo/map.ply; or --data DIR, for maps that clients make"
        raise InputError("give a map, a log or a camera.", field="--map, --log, --camera", hint=hint)
    check_exposure(settings)
    runtime = Runtime(settings, config=load_config(config))
    controller = None
    try:
        if settings.arm is not None:
            controller = _connect_arm(runtime, settings.arm)
        if map is not None:
            _add_map(runtime, map)
        elif device is not None:
            _follow_camera(runtime, device)
        elif log is not None and log_kind(log) == "rig":
            _follow_rig(runtime, log, camera)
        elif log is not None:
            _follow_log(runtime, log, camera)
        run_service(runtime, on_start=partial(_announce, settings))
    finally:
        try:
            runtime.close()
        finally:
            if controller is not None:
                controller.close()
    return 0


def _connect_arm(runtime: Runtime, address: str) -> RosController | UrController:
    """Connect the arm of the settings; the caller closes it.

    Raises:
        InputError: keys are turned off, or the arm has no model.
    """
    from splatbot.robots.controllers.addresses import connect_arm

    if runtime.settings.insecure_no_auth:
        raise InputError("moves for clients without a key.", field="--arm", hint="leave out --insecure-no-auth")
    if runtime.robot is None:
        raise InputError("has no model.", field="--arm", hint="give --robot, as `splatbot robot list` names it")
    controller = connect_arm(address, runtime.robot)
    runtime.arms.connect(runtime.robot, controller)
    return controller


def _add_map(runtime: Runtime, map_: Path) -> None:
    if is_tiled_map(map_):
        _add_tiles(runtime, map_)
        return
    from splatbot.gaussians import GaussianModel, Snapshot
    from splatbot.robots.graspable_objects import run_of
    from splatbot.workspace import find_workspace

    path = map_file(map_)
    snapshot = Snapshot(GaussianModel.load(path), map_version=1)
    runtime.store.add(
        MAP_ID,
        source=path.name,
        state="static",
        snapshot=snapshot,
        workspace=find_workspace(path),
        run=run_of(map_),
    )


def _add_tiles(runtime: Runtime, folder: Path) -> None:
    from splatbot.tiles.tiled_map import TiledMap, TileMemoryError
    from splatbot.workspace import find_workspace

    try:
        tiles = TiledMap(folder, memory_mb=runtime.settings.tiles_mb)
    except TileMemoryError as error:
        raise InputError(error.message, field="SPLATBOT_TILES_MB", hint=error.hint) from error
    scene = find_workspace(folder)
    runtime.store.add(MAP_ID, source=folder.name, state="static", awaited=False, workspace=scene, tiles=tiles)


def _follow_camera(runtime: Runtime, device: str) -> None:
    """Map a camera, opened with the delay of its joints.

    The scene is that of the settings or of the replayed log, whose camera file gives the sensor as well.
    """
    from splatbot.config import with_sensor
    from splatbot.robots.cameras import ReplayCamera, open_camera
    from splatbot.services.mapping import workspace_of
    from splatbot.slam import Slam

    workspace = runtime.workspace or workspace_of(device.removeprefix(REPLAY), None)
    mask = runtime.new_mask(workspace)
    source = open_camera(device, joint_delay=0.0 if mask is None else mask.joint_delay)
    config = runtime.config
    if isinstance(source, ReplayCamera):
        config = with_sensor(config, source.calibration.sensor, file=source.calibration.file)
    served = runtime.store.add(MAP_ID, source=source.name, state="mapping", workspace=workspace, mask=mask)
    runtime.follow(served, source, Slam(config))


def _follow_log(runtime: Runtime, log: str, camera: str | None) -> None:
    """Map a log, opened with the delay of its joints; the scene is that of the settings or of the log."""
    from splatbot.logs import open_log
    from splatbot.services.mapping import config_of, workspace_of
    from splatbot.slam import Slam

    workspace = runtime.workspace or workspace_of(log, None)
    delay = 0.0 if runtime.robot is None or workspace is None else workspace.joint_delay
    source = open_log(log, camera=camera, joint_delay=delay)
    mask = runtime.new_mask(workspace, log=source)
    served = runtime.store.add(MAP_ID, source=source.name, state="mapping", workspace=workspace, mask=mask)
    runtime.follow(served, source, Slam(config_of(source, runtime.config)))


def _follow_rig(runtime: Runtime, log: str, camera: str | None) -> None:
    """Map the recordings of several cameras; the robot is masked at the mount of each of them.

    Raises:
        InputError: one camera is given for all recordings.
    """
    from splatbot.services.mapping import config_of, open_rig
    from splatbot.slam import Slam

    if camera is not None:
        hint = "write `camera: FILE` to each camera of the file"
        raise InputError("each camera has its own.", field="--camera", hint=hint)
    source, further = open_rig(log)
    first = further.pop("")
    workspace = runtime.workspace or first
    mask = runtime.new_mask(workspace, further, log=source)
    served = runtime.store.add(MAP_ID, source=source.name, state="mapping", workspace=workspace, mask=mask)
    runtime.follow(served, source, Slam(config_of(source, runtime.config)))


def _print_new_key(words: str | None) -> int:
    from splatbot.services.keys import check_scopes, hash_key, new_key

    try:
        scopes = check_scopes([word.strip() for word in words.split(",")]) if words is not None else None
    except ValueError as error:
        raise InputError(f"{error}.", field="--scopes", hint="e.g. --scopes read,move") from error
    key = new_key()
    print(f"key (for clients; shown once): {key}")
    print(f"hash (for the service):        SPLATBOT_API_KEYS={hash_key(key, scopes)}")
    return 0


def _announce(settings: ServiceSettings, url: str) -> None:
    """Print the address, and the file of the key; the key itself only on a terminal, for other output becomes a log."""
    from splatbot.service_key import key_file
    from splatbot.services.access import Access

    print(f"serving on {url}  (routes: {url}/docs, an image: {url}/v1/maps/{MAP_ID}/render; Ctrl-C stops)", flush=True)
    access = Access(settings)
    if access.uses_key_file:
        key = access.shown_key(to_terminal=sys.stdout.isatty())
        print(f"key to map and to move: {f'{key}, ' if key else ''}in {key_file()}", flush=True)
