"""Grasps through the service moveit_msgs/GraspPlanning."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from splatbot.grasping.affordance import Hint, NameHint, PointHint, find_target
from splatbot.grasping.language import LanguageAffordance
from splatbot.grasping.options import GraspOptions
from splatbot.grasping.spatial import SpatialAffordance
from splatbot.grasping.types import Grasp
from splatbot.logs.ros_frames import header, pose_message
from splatbot.logs.ros_types import to_plain
from splatbot.protocols import Array
from splatbot.robots.robot import RobotModel
from splatbot.services.robots_in_maps import objects_in
from splatbot.services.ros.graph import RosGraph, Service
from splatbot.services.ros.messages import MAP_FRAME
from splatbot.services.ros.moveit import coded, robot_place
from splatbot.services.ros.requests import entries, entry, vector
from splatbot.services.store import MapStore
from splatbot.services.topics import GRASPS

GRASP_SERVICE = "/plan_grasps"


class GraspServices:
    """GraspPlanning on the main map of a store.

    ``target.id`` names the target as the map's scene.yaml does, or describes it in words such as "the red cube".
    Without it, the object at the target's pose is meant. The grasps are sorted, best first, and published on the bus.

    Args:
        graph: registers the service.
        store: the maps.
        robot: the arm, with fingers.
    """

    def __init__(self, graph: RosGraph, store: MapStore, *, robot: str = "panda") -> None:
        self._store, self._robot = store, robot
        graph.serve(GRASP_SERVICE, Service("moveit_msgs/srv/GraspPlanning", self.plan))

    def plan(self, args: Mapping[str, Any]) -> dict[str, Any]:
        """Answer moveit_msgs/GraspPlanning."""

        def work() -> dict[str, Any]:
            served, robot, base = robot_place(self._store, self._robot)
            objects = objects_in(served, base, as_known=True)
            target = find_target(_hint(args), objects.scene, [LanguageAffordance(), SpatialAffordance()])
            found = objects.with_notes(objects.sampler(robot).sample(target, GraspOptions()))
            found.unwrap()
            stamp = served.ready.stamp
            self._store.tell(served, GRASPS, found)
            return {"grasps": [_grasp_message(i, grasp, robot, stamp) for i, grasp in enumerate(found.grasps)]}

        return {"grasps": []} | coded(work)


def _hint(args: Mapping[str, Any]) -> Hint:
    name = entry(args, "target.id")
    if isinstance(name, str) and name.strip():
        return NameHint(name)
    primitive = next(iter(entries(args, "target.primitive_poses")), None)
    return PointHint(vector(args, "target.pose.position") + vector(primitive, "position"))


def _grasp_message(number: int, grasp: Grasp, robot: RobotModel, stamp: float) -> dict[str, Any]:
    """Return a moveit_msgs/Grasp; the tool's z axis is the approach."""
    approach, distance = grasp.T_world_tcp[:3, 2], grasp.approach_length
    approach_distance = {"desired_distance": distance, "min_distance": 0.5 * distance}
    there = to_plain(header(stamp, MAP_FRAME))
    posture = None if grasp.q is None else {"name": list(robot.chain.names), "position": np.asarray(grasp.q)}
    return {
        "id": f"{grasp.approach}-{number}",
        "pre_grasp_posture": _fingers(grasp.opening),
        "grasp_posture": _fingers(grasp.width),
        "grasp_pose": {"header": there, "pose": to_plain(pose_message(grasp.T_world_tcp))},
        "grasp_quality": grasp.total,
        "pre_grasp_approach": approach_distance | {"direction": {"header": there, "vector": _vector(approach)}},
        "post_grasp_retreat": approach_distance | {"direction": {"header": there, "vector": _vector(-approach)}},
        "max_contact_force": 0.0,
        "allowed_touch_objects": [],
        "joint_state": posture,  # not of moveit_msgs/Grasp: the arm's joints there
    }


def _fingers(opening: float) -> dict[str, Any]:
    """Return the posture of two fingers that are ``opening`` [m] apart."""
    return {"joint_names": ["finger1", "finger2"], "points": [{"positions": [opening / 2, opening / 2]}]}


def _vector(values: Array) -> dict[str, float]:
    return dict(zip("xyz", values.tolist(), strict=True))
