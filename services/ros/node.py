"""All of the service's ROS side, started and stopped with it."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from splatbot.frame import Frame
from splatbot.logs.ros_cameras import FindTransform
from splatbot.logs.ros_types import Message
from splatbot.services.arms import Arms
from splatbot.services.ros.emergency import EmergencyStopTopic
from splatbot.services.ros.follow import FollowJointTrajectory
from splatbot.services.ros.graph import RosGraph
from splatbot.services.ros.grasping import GraspServices
from splatbot.services.ros.moveit import MoveItServices
from splatbot.services.ros.nvblox import NvbloxServices
from splatbot.services.ros.publishers import RosPublishers
from splatbot.services.ros.rosapi import RosApi
from splatbot.services.ros.subscribers import MAX_PIXELS, RosSubscribers
from splatbot.services.ros.tf_republisher import TfRepublisher
from splatbot.services.store import MapStore
from splatbot.services.topics import JOINTS, ROS_ROBOT, JointState, robot_topic


class RosNode:
    """Topics and services of a store's maps.

    Args:
        store: the maps, and the bus that reports them.
        arms: executes the motions that clients send. If None, they are refused.
        robot: whose joints /joint_states are, and which plans are made for where a request names none.
        on_frame: called with each frame that clients publish. If None, frames are not mapped.
        on_joints: called with the robot's name and its joints that clients publish. If None, the bus receives them.
        max_pixels: of an image that clients publish.
        find_transform: of TF, for depth of another camera than colour.
    """

    def __init__(
        self,
        store: MapStore,
        *,
        arms: Arms | None = None,
        robot: str = "panda",
        on_frame: Callable[[Frame], Any] | None = None,
        on_joints: Callable[[str, JointState], Any] | None = None,
        max_pixels: int = MAX_PIXELS,
        find_transform: FindTransform = lambda target, source: None,
    ) -> None:
        self.graph = RosGraph()
        RosApi(self.graph)
        MoveItServices(self.graph, store, robot=robot)
        NvbloxServices(self.graph, store)
        GraspServices(self.graph, store, robot=robot)
        follow = FollowJointTrajectory(self.graph, arms, store) if arms is not None else None
        if arms is not None:
            EmergencyStopTopic(self.graph, arms)
        publish = partial(store.bus.publish, robot_topic(robot, JOINTS))
        take_joints = publish if on_joints is None else partial(on_joints, robot)

        def publish_robot(topic: str, message: Message) -> None:
            store.bus.publish(ROS_ROBOT, (topic, message), keep=False)

        self._parts: list[TfRepublisher | RosPublishers | RosSubscribers | FollowJointTrajectory] = [
            TfRepublisher(self.graph),
            RosPublishers(store.bus, self.graph),
            RosSubscribers(
                self.graph,
                take_joints,
                publish_robot,
                on_frame=on_frame,
                max_pixels=max_pixels,
                find_transform=find_transform,
            ),
        ]
        if follow is not None:
            self._parts.append(follow)

    def start(self) -> None:
        """Begin."""
        for part in self._parts:
            part.start()

    def stop(self) -> None:
        """End."""
        for part in self._parts:
            part.stop()
