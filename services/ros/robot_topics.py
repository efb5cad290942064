"""Topics of a robot's driver and of MoveIt, from which the robot is masked in live frames."""

from __future__ import annotations

from splatbot.logs.ros_transforms import TF, TF_STATIC, transforms_of
from splatbot.logs.ros_types import Message
from splatbot.robots.tf_buffer import TransformBuffer
from splatbot.services.ros.attached import AttachedObjects
from splatbot.services.ros.moveit_types import ATTACHED_TYPE, SCENE_TYPE

ATTACHED, SCENE = "/attached_collision_object", "/monitored_planning_scene"
TYPES_OF_ROBOT = {
    TF: "tf2_msgs/msg/TFMessage",
    TF_STATIC: "tf2_msgs/msg/TFMessage",
    ATTACHED: ATTACHED_TYPE,
    SCENE: SCENE_TYPE,
}


class RobotTopics:
    """The transforms and the attached objects that clients publish.

    Attributes:
        transforms: of /tf and /tf_static.
        attached: objects of /attached_collision_object and /monitored_planning_scene.
    """

    def __init__(self) -> None:
        self.transforms = TransformBuffer()
        self.attached = AttachedObjects(self.transforms)

    def take(self, topic: str, message: Message) -> None:
        """Keep the content of a message of one of the topics.

        Raises:
            InputError: an attached object cannot be covered or placed.
        """
        if topic in (TF, TF_STATIC):
            self.transforms.add(transforms_of(message, static=topic == TF_STATIC))
        elif topic == ATTACHED:
            self.attached.take_object(message)
        else:
            self.attached.take_scene(message)
