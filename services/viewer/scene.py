"""Drawing of one map in a viewer: splats, the camera and its path, the robot, its planned motion."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
import trimesh
import viser
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.collision import GaussianCollisionField, RobotSpheres
from splatbot.errors import InputError
from splatbot.gaussians import GaussianModel
from splatbot.geometry import rotation_to_quat
from splatbot.grasping.types import Grasp
from splatbot.planning import JointTrajectory
from splatbot.protocols import Array
from splatbot.rasterize.views import default_view
from splatbot.report.robot_drawing import DrawnPart
from splatbot.robots.appearance import appearance, merged
from splatbot.robots.robot import RobotModel
from splatbot.services.viewer.door import Check, guarded, no_connection
from splatbot.services.viewer.splats import Coloring, pieces
from splatbot.trajectory import Trajectory


@dataclass(frozen=True)
class ViewerSceneConstants:
    """Constants of the viewer's scene.

    Args:
        max_frusta: largest number of shown cameras.
        frustum: [m] size of a camera.
        frustum_line: [px] width of its lines.
        full_clearance: [m] an arm with at least this clearance is green.
        path_points: points of a shown path.
        mark: [m] radius of a measured point.
    """

    max_frusta: int = 60
    frustum: float = 0.04
    frustum_line: float = 1.5
    full_clearance: float = 0.1
    path_points: int = 60
    mark: float = 0.004


CONSTANTS = ViewerSceneConstants()


Posture = Literal["now", "plan"]
RobotDisplay = Literal["meshes", "certified spheres", "both", "hidden"]
ROBOT_DISPLAYS: tuple[RobotDisplay, ...] = get_args(RobotDisplay)

_GREY, _BLUE, _AMBER = (150, 150, 150), (40, 120, 255), (255, 170, 0)
_PLAN_OPACITY = 0.5


def open_server(host: str, port: int, check: Check = no_connection) -> viser.ViserServer:
    """Open viser's server without its banner; if ``port`` is taken, at the next free port.

    Args:
        host, port: where it listens.
        check: checks each connection; the default refuses all.

    Raises:
        InputError: the address cannot be listened on.
    """
    try:
        with contextlib.redirect_stdout(io.StringIO()), guarded(check):
            return viser.ViserServer(host=host, port=port, label="splatbot", verbose=False)
    except OSError as error:
        raise InputError(f"cannot listen on {host} port {port}.", field="viewer_port", hint="give another") from error


def close_server(server: viser.ViserServer) -> None:
    """End it, without a word."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


class ViewerScene:
    """Draws one map into a viser server; each call sends only the changes.

    Args:
        server: viser's.
        up: (3,) up direction in the map. If None, that of an upright first camera.
    """

    def __init__(self, server: viser.ViserServer, *, up: Array | None = None) -> None:
        self._server = server
        self._up = np.array([0.0, -1.0, 0.0]) if up is None else np.asarray(up)
        server.scene.set_up_direction(tuple(self._up.tolist()))
        self._drawn: dict[tuple[int, int, int], tuple[bytes, Any]] = {}
        self._balls: dict[str, Any] = {}
        self._meshes: dict[str, list[tuple[int, Any]]] = {}
        self._display: RobotDisplay = "meshes"
        self._unit = trimesh.creation.icosphere(subdivisions=2)

    def look(self, position: Array, target: Array, *, fov_deg: float = 50.0) -> None:
        """Set the camera position and target [m] of new browsers, and the vertical field of view [degrees]."""
        camera = self._server.initial_camera
        camera.position, camera.look_at = tuple(position.tolist()), tuple(target.tolist())
        camera.up, camera.fov = tuple(self._up.tolist()), float(np.radians(fov_deg))

    def look_at_all(self, model: GaussianModel) -> None:
        """Let browsers begin where most of a map is in view."""
        if len(model):
            _, T = default_view(model)
            target = np.median(model.means.numpy(), axis=0)
            self.look(T[:3, 3], target)

    def show_map(self, model: GaussianModel, coloring: Coloring = "rgb", *, T_world_camera: Array | None = None) -> int:
        """Show the Gaussians and return the number of pieces that were sent."""
        found, sent = pieces(model, coloring, T_world_camera=T_world_camera), 0
        with self._server.atomic():
            for key in self._drawn.keys() - found.keys():
                self._drawn.pop(key)[1].remove()
            for key, splats in found.items():
                digest = splats.digest
                old = self._drawn.get(key)
                if old is not None and old[0] == digest:
                    continue
                values = splats.centers, splats.covariances, splats.rgbs, splats.opacities
                if old is None:
                    handle = self._server.scene.add_gaussian_splats(f"/map/{key}", *values)
                else:
                    handle = old[1]
                    handle.set_gaussians(*values)
                self._drawn[key] = digest, handle
                sent += 1
        return sent

    def show_camera_path(self, trajectory: Trajectory, camera: Camera | None = None) -> None:
        """Show the camera's path as a line, with frusta along it."""
        at = trajectory.positions.astype(np.float32)
        if len(at) >= 2:
            lines = np.stack([at[:-1], at[1:]], axis=1)
            self._server.scene.add_line_segments("/camera/way", lines, _BLUE, thickness=0.002)
        chosen = (
            np.unique(np.linspace(0, len(at) - 1, min(len(at), CONSTANTS.max_frusta)).astype(int)) if len(at) else ()
        )
        for number, i in enumerate(chosen):
            self._frustum(f"/camera/frusta/{number}", trajectory.T_world_camera[i], camera, _GREY)

    def show_camera(self, T_world_camera: Array, camera: Camera | None = None) -> None:
        """Show the present pose of the camera."""
        self._frustum("/camera/now", T_world_camera, camera, _BLUE)

    def show_robot(
        self,
        arm: RobotSpheres,
        robot: RobotModel,
        q: Array,
        field: GaussianCollisionField | None,
        name: Posture = "now",
    ) -> None:
        """Show the robot at joints ``q`` (J,): its meshes, and its certified spheres coloured by clearance.

        The spheres are red in collision, and green from 10 cm of clearance. :meth:`display_robot` hides either layer.
        """
        self._show_meshes(robot, arm.T_world_base @ robot.fk(q), name)
        centers = arm.centers(q[None])[0]
        rgb = clearance_colors(field, centers, arm.spheres.radii)
        if name not in self._balls:
            self._balls[name] = self._server.scene.add_batched_meshes_simple(
                f"/robot/{name}/spheres",
                np.asarray(self._unit.vertices, np.float32),
                np.asarray(self._unit.faces, np.uint32),
                batched_wxyzs=np.tile([1.0, 0, 0, 0], (len(centers), 1)).astype(np.float32),
                batched_positions=centers.astype(np.float32),
                batched_scales=arm.spheres.radii.astype(np.float32),
                batched_colors=rgb,
                lod="off",
                opacity=_PLAN_OPACITY if name == "plan" else None,
            )
        else:
            handle = self._balls[name]
            handle.batched_positions, handle.batched_colors = centers.astype(np.float32), rgb
        self.display_robot(self._display)

    def remove_robot(self) -> None:
        """Remove the robot in all postures, and the path of its tool."""
        self._balls, self._meshes = {}, {}
        self._server.scene.remove_by_name("/robot")

    def display_robot(self, display: RobotDisplay) -> None:
        """Choose the layers of the robot that are visible."""
        self._display = display
        for handle in self._balls.values():
            handle.visible = display in ("certified spheres", "both")
        for meshes in self._meshes.values():
            for _, handle in meshes:
                handle.visible = display in ("meshes", "both")

    def _show_meshes(self, robot: RobotModel, T_world_link: Array, name: Posture) -> None:
        """Draw the appearance of the robot once, and move its links to ``T_world_link`` (L, 4, 4)."""
        if name not in self._meshes:
            self._meshes[name] = [
                (part.link, self._part(f"/robot/{name}/meshes/{k}", part, _PLAN_OPACITY if name == "plan" else None))
                for k, part in enumerate(merged(appearance(robot)))
            ]
        for link, handle in self._meshes[name]:
            handle.wxyz, handle.position = rotation_to_quat(T_world_link[link, :3, :3]), T_world_link[link, :3, 3]

    def _part(self, name: str, part: DrawnPart, opacity: float | None) -> Any:
        corners = part.triangles.reshape(-1, 3)
        return self._server.scene.add_mesh_simple(
            name,
            corners.astype(np.float32),
            np.arange(len(corners), dtype=np.uint32).reshape(-1, 3),
            color=part.color,
            flat_shading=True,
            side="double",
            opacity=opacity,
        )

    def show_plan(self, arm: RobotSpheres, plan: JointTrajectory) -> None:
        """Show the tool's path along a planned motion."""
        q = plan.at(np.linspace(0.0, plan.duration, CONSTANTS.path_points)).position
        last = int(np.flatnonzero(arm.spheres.link == arm.spheres.link.max())[-1])
        at = arm.centers(q)[:, last].astype(np.float32)
        lines = np.stack([at[:-1], at[1:]], axis=1)
        self._server.scene.add_line_segments("/robot/path", lines, _AMBER, thickness=0.008)

    def show_grasps(self, grasps: Sequence[Grasp]) -> None:
        """Show each grasp as the approach line and the line between its fingers; green marks good ones."""
        if not grasps:
            self._server.scene.remove_by_name("/grasps")
            return
        ways = [(g.T_world_pregrasp[:3, 3], g.T_world_tcp[:3, 3]) for g in grasps]
        lines = np.array([line for way, g in zip(ways, grasps, strict=True) for line in (way, g.contacts)], np.float32)
        rgb = np.array([(1.0 - g.total, g.total, 0.1) for g in grasps for _ in range(2)])
        colors = np.repeat(np.rint(255 * rgb)[:, None], 2, axis=1).astype(np.uint8)
        self._server.scene.add_line_segments("/grasps", lines, colors, thickness=0.004)

    def html(self) -> str:
        """Return the scene as one self-contained page."""
        return str(self._server.get_scene_serializer().as_html())

    def _frustum(self, name: str, T: Array, camera: Camera | None, color: tuple[int, int, int]) -> None:
        fov = 2 * np.arctan(0.5 * camera.height / camera.fy) if camera is not None else 0.8
        aspect = camera.width / camera.height if camera is not None else 4 / 3
        self._server.scene.add_camera_frustum(
            name,
            float(fov),
            aspect,
            scale=CONSTANTS.frustum,
            thickness=CONSTANTS.frustum_line,
            thickness_units="screen",  # viser's default is 2 cm, half of the frustum
            color=color,
            wxyz=rotation_to_quat(T[:3, :3]),
            position=T[:3, 3],
        )


def show_distance(scene: viser.SceneApi, points: Sequence[Array]) -> str:
    """Mark the points (3,) [m] that were clicked, at most two, and return the distance between two as a text."""
    for name in ("/measure/line", "/measure/label", "/measure/0", "/measure/1"):
        scene.remove_by_name(name)
    for k, point in enumerate(points):
        scene.add_icosphere(f"/measure/{k}", CONSTANTS.mark, _AMBER, position=point)
    if len(points) < 2:
        return ""
    line = np.stack(points)[None].astype(np.float32)
    scene.add_line_segments("/measure/line", line, _AMBER, thickness=0.002)
    text = f"{1e3 * np.linalg.norm(points[1] - points[0]):.0f} mm"
    scene.add_label("/measure/label", text, position=(points[0] + points[1]) / 2)
    return text


def clearance_colors(
    field: GaussianCollisionField | None, centers: Array, radii: NDArray[np.float64]
) -> NDArray[np.uint8]:
    """Color spheres (S, 3), (S,) [m] by clearance: red at 0, yellow at 5 cm, green from 10 cm; grey without a map."""
    if field is None or not len(field):
        return np.tile(np.array(_GREY, np.uint8), (len(centers), 1))
    clearance = field.clearance(np.column_stack([centers, radii]), cut=CONSTANTS.full_clearance).distance
    share = np.clip(clearance / CONSTANTS.full_clearance, 0.0, 1.0)
    red, green = np.clip(2 - 2 * share, 0, 1), np.clip(2 * share, 0, 1)
    return np.rint(255 * np.column_stack([red, green, 0.1 * np.ones_like(share)])).astype(np.uint8)
