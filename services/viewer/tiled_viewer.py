"""The viewer of a tiled map: each browser has the tiles of its own camera."""

from __future__ import annotations

import logging
import threading
import time
import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
import viser

from splatbot.collision import GaussianCollisionField, RobotSpheres
from splatbot.errors import InputError
from splatbot.protocols import Array
from splatbot.robots.joint_offsets import robot_in_scene
from splatbot.robots.store import load_robot
from splatbot.services.access import Access
from splatbot.services.threads import join_started
from splatbot.services.viewer.door import Door
from splatbot.services.viewer.scene import CONSTANTS as SCENE
from splatbot.services.viewer.scene import ROBOT_DISPLAYS, ViewerScene, close_server, open_server
from splatbot.services.viewer.tile_browser import TileBrowser
from splatbot.tiles.tiled_map import CONSTANTS as TILES
from splatbot.tiles.tiled_map import TiledMap, TileMemoryError
from splatbot.trajectory import Trajectory
from splatbot.workspace import Workspace


@dataclass(frozen=True)
class TiledViewerConstants:
    """Constants of the viewer of a tiled map.

    Args:
        browsers: at once; the server keeps the tiles of each.
    """

    browsers: int = 8


CONSTANTS = TiledViewerConstants()

_log = logging.getLogger(__name__)


class TiledViewer:
    """A web page at http://HOST:PORT that shows a tiled map by levels of detail.

    One thread serves the browsers in the order in which their changes are due. A camera that moves is served when it
    rests, with its latest pose. So the work does not grow with the number of its messages.

    Args:
        tiles: the map; the viewer does not close it.
        access: rights to open the page.
        host, port: where the page is served, at the next free port where that one is taken; 0 takes any.
        pixel_error: largest edge of a cell of merged Gaussians [px].
        robot: the arm that is shown at home if the scene defines its base.
        workspace: the scene.
        trajectory: of the camera.

    Raises:
        InputError: the pixel error is negative or not finite, the host cannot be listened on, or no robot has the name.
        FormatError: the coarsest tile is damaged.
    """

    def __init__(
        self,
        tiles: TiledMap,
        access: Access,
        *,
        host: str = "127.0.0.1",
        port: int = 8080,
        pixel_error: float = TILES.pixel_error,
        robot: str = "panda",
        workspace: Workspace | None = None,
        trajectory: Trajectory | None = None,
    ) -> None:
        if not 0.0 <= pixel_error < np.inf:
            raise InputError(f"is {pixel_error}.", field="pixel_error", hint="give pixels, 0 or more")
        self._tiles, self._pixel_error, self._overview = tiles, pixel_error, tiles.overview()
        means = self._overview.means.numpy()
        self._middle: Array = np.median(means, axis=0) if len(means) else np.zeros(3)
        self._browsers: dict[int, TileBrowser] = {}
        self._wake, self._stopping = threading.Condition(), False
        self._worker = threading.Thread(target=self._serve, name="viewer-tiles", daemon=True)
        # A browser may close while tiles are on their way: viser warns of each.
        warnings.filterwarnings("ignore", message="Queued a .* on a closed connection")
        self.server = open_server(host, port, Door(access, CONSTANTS.browsers))
        self.port = self.server.get_port()
        try:
            self._scene = ViewerScene(self.server)
            self._scene.look_at_all(self._overview)
            if trajectory is not None:
                self._scene.show_camera_path(trajectory)
            self._note = self._place_robot(robot, workspace)
        except BaseException:
            close_server(self.server)
            raise
        self.server.on_client_connect(self._meet)
        self.server.on_client_disconnect(self._part)

    def start(self) -> None:
        """Begin."""
        self._worker.start()

    def stop(self, timeout_s: float = 5.0) -> None:
        """End, and close the page's connections."""
        with self._wake:
            self._stopping = True
            self._wake.notify()
        join_started([self._worker], timeout_s)
        close_server(self.server)

    async def _meet(self, client: viser.ClientHandle) -> None:
        browser = TileBrowser(
            client,
            self._tiles,
            self._notify,
            pixel_error=self._pixel_error,
            middle=self._middle,
            overview=self._overview,
            note=self._note,
        )
        with self._wake:
            self._browsers[client.client_id] = browser
            self._wake.notify()

    async def _part(self, client: viser.ClientHandle) -> None:
        browser = self._browsers.get(client.client_id)
        if browser is not None:
            browser.leave()

    def _notify(self) -> None:
        with self._wake:
            self._wake.notify()

    def _serve(self) -> None:
        while (number := self._next()) is not None:
            browser = self._browsers[number]
            try:
                if browser.has_left:
                    del self._browsers[number]
                    browser.release()
                else:
                    browser.update()
            except Exception:  # one odd browser must not end the view of the others
                _log.exception("the viewer could not show the tiles")

    def _next(self) -> int | None:
        """Wait for the browser whose update is due first, and return its number; None ends the view."""
        with self._wake:
            while not self._stopping:
                due = {number: browser.due_s for number, browser in self._browsers.items()}
                first = min(due, key=due.__getitem__, default=None)
                wait = np.inf if first is None else due[first] - time.monotonic()
                if wait <= 0:
                    return first
                self._wake.wait(None if np.isinf(wait) else wait)
        return None

    def _place_robot(self, name: str, workspace: Workspace | None) -> str:
        """Show the robot at home, coloured by its clearance from the tiles around it, and return a note for the page.

        Raises:
            InputError: no robot has the name.
        """
        base = workspace.T_world_base if workspace is not None else None
        if base is None:
            return ""
        robot = load_robot(name)
        try:
            robot = robot_in_scene(robot, workspace)
        except InputError as error:
            return f"no robot: {error}"
        self._middle = base[:3, 3]
        arm, q = RobotSpheres(robot, T_world_base=base), np.asarray(robot.home)
        field, note = self._field_of(arm, q)
        self._scene.show_robot(arm, robot, q, field)
        display = self.server.gui.add_dropdown("robot", ROBOT_DISPLAYS, initial_value="meshes")

        @display.on_update
        def _(_: Any) -> None:
            self._scene.display_robot(display.value)

        return note

    def _field_of(self, arm: RobotSpheres, q: Array) -> tuple[GaussianCollisionField | None, str]:
        """Return the field around the spheres of an arm, or None with the reason if its tiles exceed the memory."""
        centers, radii = arm.centers(q[None])[0], arm.spheres.radii[:, None]
        low, high = (centers - radii).min(axis=0), (centers + radii).max(axis=0)
        try:
            return self._tiles.field(low, high, reach=SCENE.full_clearance).field, ""
        except TileMemoryError as error:
            return None, f"the robot's spheres are grey: {error}"
