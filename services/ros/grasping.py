"""Grasps as moveit_msgs/GraspPlanning asks for them, and as markers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from splatbot.grasping.affordance import Hint, NameHint, PointHint, find_target
from splatbot.grasping.options import GraspOptions
from splatbot.grasping.places import PlaceAffordance
from splatbot.grasping.sampler import GraspSampler
from splatbot.grasping.types import Grasp
from splatbot.grasping.words import WordAffordance
from splatbot.logs.ros_frames import header, pose_message
from splatbot.logs.ros_types import Message, build, to_plain
from splatbot.protocols import Array
from splatbot.robots.robot import RobotModel
from splatbot.segmentation import segment
from splatbot.services.ros.graph import RosGraph, Service
from splatbot.services.ros.messages import MAP_FRAME
from splatbot.services.ros.moveit import coded, robot_place
from splatbot.services.ros.requests import entries, entry, vector
from splatbot.services.store import MapStore

GRASP_SERVICE, MARKERS = "/plan_grasps", "/grasps/markers"
_ARROW = 0  # of visualization_msgs/Marker


class GraspServices:
    """GraspPlanning on the main map of a store.

    The target is the thing of that ``target.id`` (a name of the map's scene.yaml, or words such as "the red cube"), or
    what is at its pose. The answer's grasps are sorted, best first, and shown as arrows on /grasps/markers.

    Args:
        graph: is told of the service.
        store: the maps.
        robot: the arm, with fingers.
    """

    def __init__(self, graph: RosGraph, store: MapStore, *, robot: str = "panda") -> None:
        self._graph, self._store, self._robot = graph, store, robot
        graph.advertise(MARKERS, "visualization_msgs/msg/MarkerArray")
        graph.serve(GRASP_SERVICE, Service("moveit_msgs/srv/GraspPlanning", self.plan))

    def plan(self, args: Mapping[str, Any]) -> dict[str, Any]:
        """moveit_msgs/GraspPlanning."""

        def work() -> dict[str, Any]:
            served, robot, base = robot_place(self._store, self._robot)
            known = served.workspace
            assert known is not None
            scene = segment(served.ready.model, base, box=known.box, plane=known.support_plane, names=known.objects)
            target = find_target(_hint(args), scene, [WordAffordance(), PlaceAffordance()])
            found = GraspSampler(scene, robot).sample(target, GraspOptions())
            found.unwrap()
            stamp = served.ready.stamp
            self._graph.publish(MARKERS, grasps_message(found.grasps, stamp), latched=True)
            return {"grasps": [_told(i, grasp, robot, stamp) for i, grasp in enumerate(found.grasps)]}

        return {"grasps": []} | coded(work)


def _hint(args: Mapping[str, Any]) -> Hint:
    name = entry(args, "target.id")
    if isinstance(name, str) and name.strip():
        return NameHint(name)
    primitive = next(iter(entries(args, "target.primitive_poses")), None)
    return PointHint(vector(args, "target.pose.position") + vector(primitive, "position"))


def _told(number: int, grasp: Grasp, robot: RobotModel, stamp: float) -> dict[str, Any]:
    """moveit_msgs/Grasp; the tool's z is the approach."""
    approach, distance = grasp.T_world_tcp[:3, 2], _apart(grasp)
    way = {"desired_distance": distance, "min_distance": 0.5 * distance}
    there = to_plain(header(stamp, MAP_FRAME))
    posture = None if grasp.q is None else {"name": list(robot.chain.names), "position": np.asarray(grasp.q)}
    return {
        "id": f"{grasp.approach}-{number}",
        "pre_grasp_posture": _fingers(grasp.opening),
        "grasp_posture": _fingers(grasp.width),
        "grasp_pose": {"header": there, "pose": to_plain(pose_message(grasp.T_world_tcp))},
        "grasp_quality": grasp.total,
        "pre_grasp_approach": way | {"direction": {"header": there, "vector": _vector(approach)}},
        "post_grasp_retreat": way | {"direction": {"header": there, "vector": _vector(-approach)}},
        "max_contact_force": 0.0,
        "allowed_touch_objects": [],
        "joint_state": posture,  # not of moveit_msgs/Grasp: the arm's joints there
    }


def _apart(grasp: Grasp) -> float:
    return float(np.linalg.norm(grasp.T_world_tcp[:3, 3] - grasp.T_world_pregrasp[:3, 3]))


def _fingers(opening: float) -> dict[str, Any]:
    """Two fingers that are ``opening`` [m] apart."""
    return {"joint_names": ["finger1", "finger2"], "points": [{"positions": [opening / 2, opening / 2]}]}


def _vector(values: Array) -> dict[str, float]:
    return dict(zip("xyz", values.tolist(), strict=True))


def grasps_message(grasps: Sequence[Grasp], stamp: float) -> Message:
    """visualization_msgs/MarkerArray: an arrow for each grasp from its start to the thing, the greener the better."""
    markers = [
        {
            "header": header(stamp, MAP_FRAME),
            "ns": "grasps",
            "id": i,
            "type": _ARROW,
            "pose": {"orientation": {"w": 1.0}},
            "scale": {"x": 0.004, "y": 0.01, "z": 0.0},
            "color": {"r": 1.0 - grasp.total, "g": grasp.total, "b": 0.1, "a": 1.0},
            "points": [_vector(T[:3, 3]) for T in (grasp.T_world_pregrasp, grasp.T_world_tcp)],
        }
        for i, grasp in enumerate(grasps)
    ]
    return build("visualization_msgs/msg/MarkerArray", markers=markers)
