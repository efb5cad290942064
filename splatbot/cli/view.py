"""`splatbot view`: a map in a web browser."""

from __future__ import annotations

import sys
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from splatbot.cli.paths import check_output
from splatbot.cli.placing import named_robot
from splatbot.cli.tiled import check_tiled
from splatbot.layouts import is_tiled_map, map_file

if TYPE_CHECKING:
    from splatbot.gaussians import GaussianModel
    from splatbot.services.store import MapStore
    from splatbot.tiles import TiledMap
    from splatbot.trajectory import Trajectory
    from splatbot.workspace import Workspace


def view(
    map: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="MAP|RUN|TILES")],
    /,
    *,
    host: str = "127.0.0.1",
    port: int = 8080,
    robot: str = "panda",
    html: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
    pixel_error: Annotated[float | None, tyro.conf.arg(metavar="PX")] = None,
    memory_mb: Annotated[float | None, tyro.conf.arg(metavar="MB")] = None,
) -> None:
    """Show a map's Gaussians in a web browser, with the camera's trajectory and the robot if they are known.

    Each browser of a tiled map receives the tiles of its view: the coarsest first, finer ones when its camera rests.
    Surfels are drawn as thin Gaussians; `splatbot render` draws them as discs.

    Examples:
        splatbot view runs/demo
        splatbot view runs/demo --port 9000
        splatbot view runs/demo --html demo.html
        splatbot view building-tiles --memory-mb 48

    Args:
        map: a map file, a run folder that holds map.ply, or the folder of a tiled map.
        host: address to listen on; beyond 127.0.0.1 the page needs a key of SPLATBOT_API_KEYS.
        port: port to listen on; 0 takes a free one.
        robot: the arm to show, if a scene.yaml next to the map defines its base.
        html: write one self-contained page, and exit.
        pixel_error: of a tiled map: largest edge of a cell of merged Gaussians [px], by default 1. 0 is exact.
        memory_mb: of a tiled map: memory of tiles, and largest size of those of a browser [MB], by default 24.
    """
    is_tiled = is_tiled_map(map)
    file = map if is_tiled else map_file(map)
    tiled = {"--pixel-error": pixel_error, "--memory-mb": memory_mb}
    check_tiled(is_tiled, whole={"--html": html}, tiled=tiled)
    check_output(html, "--html", folder=False)
    named_robot(robot)

    from splatbot.services.access import Access
    from splatbot.services.runtime import check_exposure
    from splatbot.services.settings import load_settings
    from splatbot.services.viewer.door import opening_address
    from splatbot.services.viewer.tiled_viewer import TiledViewer
    from splatbot.services.viewer.viewer import Viewer
    from splatbot.tiles.tiled_map import CONSTANTS
    from splatbot.trajectory import Trajectory
    from splatbot.workspace import find_workspace

    path = (file if is_tiled else file.parent) / "trajectory.tum"
    trajectory = Trajectory.load(path) if path.exists() else None
    workspace = find_workspace(map)
    if html is not None:
        _write_page(html, _loaded(file), trajectory, workspace, robot)
        return
    settings = load_settings(host=host)
    check_exposure(settings)
    access = Access(settings)
    viewer: Viewer | TiledViewer
    if is_tiled:
        viewer = TiledViewer(
            _tiles(map, memory_mb),
            access,
            host=host,
            port=port,
            pixel_error=CONSTANTS.pixel_error if pixel_error is None else pixel_error,
            robot=robot,
            workspace=workspace,
            trajectory=trajectory,
        )
    else:
        store = _store(file.name, _loaded(file), trajectory, workspace)
        viewer = Viewer(store, access, host=host, port=port, robot=robot)
    viewer.start()
    address = opening_address(access, host, viewer.port, to_terminal=sys.stdout.isatty())
    print(f"{address} shows {file}; Ctrl-C ends", flush=True)
    try:
        threading.Event().wait()
    finally:
        viewer.stop()


def _loaded(file: Path) -> GaussianModel:
    """Load a map, and say how its surfels are drawn."""
    from splatbot.gaussians import GaussianModel
    from splatbot.gaussians.surfels import holds_surfels

    model = GaussianModel.load(file)
    if holds_surfels(model):
        print(f"{file.name} holds surfels: browsers draw thin Gaussians, `splatbot render` draws discs", flush=True)
    return model


def _write_page(
    html: Path, model: GaussianModel, trajectory: Trajectory | None, workspace: Workspace | None, robot: str
) -> None:
    from splatbot.atomic import atomic_write
    from splatbot.services.viewer.page import map_page

    page = map_page(model, trajectory=trajectory, workspace=workspace, robot=robot)
    with atomic_write(html) as handle:
        handle.write(page.encode())
    print(f"{html}: {html.stat().st_size / 1e6:.1f} MB")


def _store(name: str, model: GaussianModel, trajectory: Trajectory | None, workspace: Workspace | None) -> MapStore:
    """Return the store of one map, of a file of that name."""
    from splatbot.gaussians import Snapshot
    from splatbot.services.store import MapStore

    store, snapshot = MapStore(), Snapshot(model, 1)
    store.add("default", source=name, state="static", snapshot=snapshot, trajectory=trajectory, workspace=workspace)
    return store


def _tiles(folder: Path, memory_mb: float | None) -> TiledMap:
    """Open a tiled map."""
    from splatbot.tiles.tiled_map import CONSTANTS, TiledMap

    return TiledMap(folder, memory_mb=CONSTANTS.memory_mb if memory_mb is None else memory_mb)
