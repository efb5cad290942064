"""`splatbot view`: a map in a web browser."""

from __future__ import annotations

import sys
import threading
from pathlib import Path
from typing import Annotated

import tyro

from splatbot.cli.paths import check_output
from splatbot.cli.placing import named_robot
from splatbot.layouts import map_file


def view(
    map: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="MAP|RUN")],
    /,
    *,
    host: str = "127.0.0.1",
    port: int = 8080,
    robot: str = "panda",
    html: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
) -> None:
    """Show a map's Gaussians in a web browser, with the camera's trajectory and the robot if they are known.

    Examples:
        splatbot view runs/demo
        splatbot view runs/demo --port 9000
        splatbot view runs/demo --html demo.html

    Args:
        map: a map file, or a run folder that holds map.ply.
        host: address to listen on; beyond 127.0.0.1 the page needs a key of SPLATBOT_API_KEYS.
        port: port to listen on; 0 takes a free one.
        robot: the arm to show, if a scene.yaml next to the map defines its base.
        html: write one self-contained page, and exit.
    """
    file = map_file(map)
    check_output(html, "--html", folder=False)
    named_robot(robot)

    from splatbot.atomic import atomic_write
    from splatbot.gaussians import GaussianModel, Snapshot
    from splatbot.services.access import Access
    from splatbot.services.runtime import check_exposure
    from splatbot.services.settings import load_settings
    from splatbot.services.store import MapStore
    from splatbot.services.viewer.door import opening_address
    from splatbot.services.viewer.page import map_page
    from splatbot.services.viewer.viewer import Viewer
    from splatbot.trajectory import Trajectory
    from splatbot.workspace import find_workspace

    model, workspace = GaussianModel.load(file), find_workspace(map)
    path = file.with_name("trajectory.tum")
    trajectory = Trajectory.load(path) if path.exists() else None
    if html is not None:
        with atomic_write(html) as handle:
            handle.write(map_page(model, trajectory=trajectory, workspace=workspace, robot=robot).encode())
        print(f"{html}: {html.stat().st_size / 1e6:.1f} MB")
        return
    store = MapStore()
    store.add(
        "default",
        source=file.name,
        state="static",
        snapshot=Snapshot(model, 1),
        trajectory=trajectory,
        workspace=workspace,
    )
    settings = load_settings(host=host)
    check_exposure(settings)
    access = Access(settings)
    viewer = Viewer(store, access, host=host, port=port, robot=robot)
    viewer.start()
    address = opening_address(access, host, viewer.port, to_terminal=sys.stdout.isatty())
    print(f"{address} shows {file}; Ctrl-C ends", flush=True)
    try:
        threading.Event().wait()
    finally:
        viewer.stop()
