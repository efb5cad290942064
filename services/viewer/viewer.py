"""The live viewer: follows a bus and shows its main map, at most twice a second."""

from __future__ import annotations

import logging
import threading
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from splatbot.camera import Camera
from splatbot.collision import RobotSpheres
from splatbot.errors import InputError
from splatbot.frame import Frame
from splatbot.gaussians import GaussianModel
from splatbot.grasping.types import GraspResult
from splatbot.planning import JointTrajectory
from splatbot.protocols import Array
from splatbot.robots.robot import RobotModel
from splatbot.services.access import Access
from splatbot.services.bus import Message
from splatbot.services.robots_in_maps import robot_in
from splatbot.services.store import MapStore, ServedMap
from splatbot.services.threads import join_started
from splatbot.services.topics import FRAME, GRASPS, PLAN, RESULT, STATE, TRAJECTORY, JointState
from splatbot.services.viewer.door import Door
from splatbot.services.viewer.measuring import surface_point
from splatbot.services.viewer.scene import ROBOT_DISPLAYS, ViewerScene, close_server, open_server, show_distance
from splatbot.services.viewer.splats import COLORINGS, Coloring
from splatbot.slam import FrameResult
from splatbot.trajectory import Trajectory


@dataclass(frozen=True)
class ViewerConstants:
    """Constants of the viewer.

    Args:
        period: [s] time between two updates.
        max_waiting: largest number of messages that wait.
        least_crop: [m] least distance of the crop.
        no_crop: [m] distance from which everything is shown.
    """

    period: float = 0.5
    max_waiting: int = 256
    least_crop: float = 0.2
    no_crop: float = 5.0


CONSTANTS = ViewerConstants()


_log = logging.getLogger(__name__)


@dataclass
class _News:
    """The latest value of each kind; None if it has not arrived, or has been shown."""

    served: ServedMap | None = None
    result: FrameResult | None = None
    trajectory: Trajectory | None = None
    plan: JointTrajectory | None = None
    grasps: GraspResult | None = None
    joints: JointState | None = None
    camera: Camera | None = None


class Viewer:
    """A web page at http://HOST:PORT that shows a map as it grows.

    Args:
        store: the maps; ``map_id`` is shown, or the first one there is.
        access: rights to open the page.
        host, port: where the page is served, at the next free port where that one is taken; 0 takes any.
        robot: the arm that is shown where its base is known.
        map_id: name of the map. If None, the first map is shown.

    Raises:
        InputError: the host cannot be listened on.
    """

    def __init__(
        self,
        store: MapStore,
        access: Access,
        *,
        host: str = "127.0.0.1",
        port: int = 8080,
        robot: str = "panda",
        map_id: str | None = None,
    ) -> None:
        self._store, self._map_id, self._robot_name = store, map_id, robot
        self.server = open_server(host, port, Door(access))
        self._host, self.port = host, self.server.get_port()
        self._scene = ViewerScene(self.server)
        self._news, self._lock = _News(), threading.Lock()
        self._served: ServedMap | None = None
        self._pose: Array | None = None
        self._arm: RobotSpheres | None = None
        self._robot: RobotModel | None = None
        self._no_robot = ""
        self._clicked: list[Array] = []
        self._plan: JointTrajectory | None = None
        self._camera: Camera | None = None
        self._coloring: Coloring = "rgb"
        self._stale = False
        self._add_controls()
        self._reader = store.bus.subscribe("maps/*", "robot/*/joints", capacity=CONSTANTS.max_waiting)
        self._stopping = threading.Event()
        work = {"viewer-collect": self._collect, "viewer-draw": self._draw}
        self._threads = [threading.Thread(target=run, name=name, daemon=True) for name, run in work.items()]

    def start(self) -> None:
        """Begin."""
        for thread in self._threads:
            thread.start()
        _log.info("the viewer is at http://%s:%d/?key=KEY, with the key of the service", self._host, self.port)

    def stop(self, timeout_s: float = 5.0) -> None:
        """End, and close the page's connections."""
        self._stopping.set()
        self._reader.close()
        join_started(self._threads, timeout_s)
        close_server(self.server)

    def html(self) -> str:
        """Return the present view as one self-contained page."""
        return self._scene.html()

    def _add_controls(self) -> None:
        gui = self.server.gui
        self._state = gui.add_markdown("waiting for a map")
        coloring = gui.add_dropdown("colours", COLORINGS, initial_value="rgb")
        display = gui.add_dropdown("robot", ROBOT_DISPLAYS, initial_value="meshes")
        self._crop = gui.add_slider(
            "crop, m",
            CONSTANTS.least_crop,
            CONSTANTS.no_crop,
            0.1,
            CONSTANTS.no_crop,
            hint=f"distance from the base, or from the middle of the map; {CONSTANTS.no_crop:g} shows all",
        )
        self._measure = gui.add_checkbox("measure", False, hint="click two points of the map")
        self._distance = gui.add_markdown("")
        self._slider = gui.add_slider("planned motion", 0.0, 1.0, 0.01, 0.0, disabled=True)
        self._timings = gui.add_markdown("")

        @coloring.on_update
        def _(_: Any) -> None:
            self._coloring, self._stale = coloring.value, True

        @display.on_update
        def _(_: Any) -> None:
            self._scene.display_robot(display.value)

        @self._crop.on_update
        def _(_: Any) -> None:
            self._stale = True

        @self._measure.on_update
        def _(_: Any) -> None:
            self._show_clicked([])

        @self.server.scene.on_click()
        def _(event: Any) -> None:
            if self._measure.value:
                self._take_click(np.asarray(event.ray_origin), np.asarray(event.ray_direction))

        @self._slider.on_update
        def _(_: Any) -> None:
            self._show_plan_at(self._slider.value)

    def _take_click(self, origin: Array, direction: Array) -> None:
        """Keep the point of the shown map that a click means; a third click begins again."""
        shown = self._shown()
        point = surface_point(shown, origin, direction) if shown is not None else None
        if point is not None:
            self._show_clicked([*self._clicked, point] if len(self._clicked) < 2 else [point])

    def _show_clicked(self, points: list[Array]) -> None:
        self._clicked = points
        self._distance.content = show_distance(self.server.scene, points)

    def _shown(self) -> GaussianModel | None:
        """Return the Gaussians within the crop, or None without a map."""
        served = self._served
        if served is None or served.snapshot is None:
            return None
        model, radius = served.snapshot.model, self._crop.value
        if radius >= CONSTANTS.no_crop or not len(model):
            return model
        middle = model.means.median(dim=0).values
        if self._arm is not None:
            middle = torch.from_numpy(self._arm.T_world_base[:3, 3]).to(model.means)
        return model.select((model.means - middle).norm(dim=1) <= radius)

    def _collect(self) -> None:
        """Keep the latest of each kind; values that arrive faster than they are drawn are skipped."""
        for message in self._reader:
            with self._lock:
                self._take(message)

    def _take(self, message: Message) -> None:
        value = message.value
        if isinstance(value, JointState):
            self._news.joints = value
            return
        _, map_id, kind = message.topic.split("/", 2)
        self._map_id = self._map_id or map_id
        if map_id != self._map_id:
            return
        if kind == STATE:
            self._news.served = value
        elif kind == RESULT:
            self._news.result = value
        elif kind == TRAJECTORY:
            self._news.trajectory = value
        elif kind == PLAN:
            self._news.plan = value
        elif kind == GRASPS:
            self._news.grasps = value
        elif kind == FRAME and isinstance(value, Frame):
            self._news.camera = value.camera

    def _draw(self) -> None:
        while not self._stopping.is_set():
            begun = time.monotonic()
            with self._lock:
                news, self._news = self._news, _News()
            try:
                self._show(news)
            except Exception:  # one odd value must not end the view
                _log.exception("the viewer could not show the update")
            self._stopping.wait(max(CONSTANTS.period - (time.monotonic() - begun), 0.05))

    def _show(self, news: _News) -> None:
        self._camera = news.camera or self._camera
        if news.result is not None:
            self._show_result(news.result)
        if news.served is not None:
            self._take_map(news.served)
        served = self._served
        if served is not None and served.snapshot is not None and (news.served is not None or self._stale):
            self._stale = False
            shown = self._shown()
            assert shown is not None
            self._scene.show_map(shown, self._coloring, T_world_camera=self._pose)
        if news.trajectory is not None:
            self._scene.show_camera_path(news.trajectory, self._camera)
        if news.plan is not None and self._arm is not None:
            self._plan = news.plan
            self._scene.show_plan(self._arm, news.plan)
            self._slider.disabled = False
            self._show_plan_at(self._slider.value)
        if news.grasps is not None:
            self._scene.show_grasps(news.grasps.grasps)
        if news.joints is not None and self._arm is not None and self._robot is not None and served is not None:
            self._scene.show_robot(self._arm, self._robot, news.joints.position, served.field)

    def _take_map(self, served: ServedMap) -> None:
        old, self._served = self._served, served
        first = old is None or old.snapshot is None or old.generation != served.generation
        if first and served.snapshot is not None:
            self._place_robot(served)
            self._scene.look_at_all(served.snapshot.model)
        self._state.content = f"**{served.id}** {served.state}, version {served.map_version}{self._no_robot}"
        if first and served.trajectory is not None:
            self._scene.show_camera_path(served.trajectory, self._camera)

    def _place_robot(self, served: ServedMap) -> None:
        """Show the robot at home in a new map. Without a base, or in the scene of another arm, the map has no robot."""
        self._scene.remove_robot()
        self._arm = self._robot = self._plan = None
        self._slider.disabled, self._no_robot = True, ""
        base = served.workspace.T_world_base if served.workspace is not None else None
        if base is None:
            return
        try:
            self._robot = robot_in(served, self._robot_name)
        except InputError as error:
            self._no_robot = f"\n\nno robot: {error}"
            return
        self._arm = RobotSpheres(self._robot, T_world_base=base)
        self._scene.show_robot(self._arm, self._robot, np.asarray(self._robot.home), served.field)

    def _show_result(self, result: FrameResult) -> None:
        if result.T_world_camera is not None:
            self._pose = result.T_world_camera
            self._scene.show_camera(result.T_world_camera, self._camera)
        rows = "\n".join(f"| {name} | {ms:.1f} |" for name, ms in result.stage_ms.items())
        self._timings.content = f"frame {result.index}: {result.verdict}\n\n| stage | ms |\n|---|---|\n{rows}"

    def _show_plan_at(self, share: float) -> None:
        arm, robot, plan, served = self._arm, self._robot, self._plan, self._served
        if arm is not None and robot is not None and plan is not None and served is not None:
            q = plan.at(share * plan.duration).position
            self._scene.show_robot(arm, robot, np.asarray(q), served.field, "plan")
