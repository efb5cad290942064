"""A map as one HTML page that can be turned, needs nothing else and fetches nothing."""

from __future__ import annotations

import numpy as np

from splatbot.collision import GaussianCollisionField, RobotSpheres
from splatbot.gaussians import GaussianModel
from splatbot.planning import JointTrajectory
from splatbot.robots.joint_offsets import robot_in_scene
from splatbot.robots.store import load_robot
from splatbot.services.viewer.scene import ViewerScene, close_server, open_server
from splatbot.services.viewer.splats import Coloring
from splatbot.trajectory import Trajectory
from splatbot.workspace import Workspace


def map_page(
    model: GaussianModel,
    *,
    coloring: Coloring = "rgb",
    trajectory: Trajectory | None = None,
    workspace: Workspace | None = None,
    robot: str = "panda",
    plan: JointTrajectory | None = None,
) -> str:
    """Return the page's text; about 1 MB and 43 bytes a Gaussian.

    Args:
        model: the map.
        coloring: see :func:`splatbot.services.viewer.splats.pieces`.
        trajectory: of the camera.
        workspace: with a base, the robot is shown at home, or where ``plan`` begins.
        robot: its name.
        plan: a motion of it.
    """
    server = open_server("127.0.0.1", 0)
    try:
        scene = ViewerScene(server)
        scene.look_at_all(model)
        scene.show_map(model, coloring)
        if trajectory is not None:
            scene.show_camera_path(trajectory)
        if workspace is not None and workspace.T_world_base is not None:
            known = robot_in_scene(load_robot(robot), workspace)
            arm = RobotSpheres(known, T_world_base=workspace.T_world_base)
            q = plan.start if plan is not None else np.asarray(known.home)
            scene.show_robot(arm, known, q, GaussianCollisionField(model))
            if plan is not None:
                scene.show_plan(arm, plan)
        return scene.html()
    finally:
        close_server(server)
