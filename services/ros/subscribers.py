"""Frames, joints, transforms and attached objects that clients publish as ROS messages."""

from __future__ import annotations

import logging
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from typing import Any

from splatbot.errors import SplatbotError
from splatbot.frame import Frame
from splatbot.logs.index import MAX_STAMP_DIFFERENCE_S
from splatbot.logs.mcap import COLOR, DEPTH, INFO, JOINTS
from splatbot.logs.ros_cameras import FindTransform, RosCameras
from splatbot.logs.ros_frames import RosFrame, camera_of, color_of, depth_of, seconds_of, size_of
from splatbot.logs.ros_types import Message
from splatbot.services.bus import Subscription
from splatbot.services.problems import BusyError, TooLargeError
from splatbot.services.ros.graph import RosGraph
from splatbot.services.ros.messages import joints_of
from splatbot.services.ros.moveit_types import register_moveit_types
from splatbot.services.ros.publishers import FROM_ROS
from splatbot.services.ros.robot_topics import TYPES_OF_ROBOT
from splatbot.services.ros.wire import RosMessage
from splatbot.services.threads import join_started
from splatbot.services.topics import JointState

DEPTH_INFO = "/camera/depth/camera_info"
"""Intrinsics of depth, where it is of another camera than colour."""
MAX_PIXELS = 2_100_000  # of an image, unless the settings of the service say otherwise
_WAITING = 16
_WARN_EVERY_S = 10.0  # [s] between two warnings of one problem
_WAITING_STATES = 2000  # 2 s of a robot at 1 kHz, while an image is decoded; also of its transforms

_log = logging.getLogger(__name__)


class RosSubscribers:
    """Three threads: one builds frames from clients' images, the others take joint states, and TF with MoveIt's topics.

    A frame is a colour image, the depth image nearest in time (within 0.02 s) and the latest CameraInfo. Unusable
    messages are logged, which also reaches /rosout. Depth of another camera than colour has a CameraInfo of its own.

    Args:
        graph: where clients publish.
        on_joints: called with the joints of /joint_states.
        on_robot: called with the topic and each message of TF and of attached objects.
        on_frame: called with each frame. If None, images are only forwarded to other clients.
        max_pixels: of an image.
        find_transform: of TF, for depth of another camera than colour.
    """

    def __init__(
        self,
        graph: RosGraph,
        on_joints: Callable[[JointState], Any],
        on_robot: Callable[[str, Message], Any],
        *,
        on_frame: Callable[[Frame], Any] | None = None,
        max_pixels: int = MAX_PIXELS,
        find_transform: FindTransform = lambda target, source: None,
    ) -> None:
        self._on_joints, self._on_robot, self._on_frame = on_joints, on_robot, on_frame
        self.dropped = 0
        self._problems: dict[str, tuple[str, float, int]] = {}  # by topic: the last one, its time [s], its repetitions
        self._pairs = FramePairs(max_pixels, find_transform)
        register_moveit_types()
        graph.advertise(DEPTH_INFO, "sensor_msgs/msg/CameraInfo")
        for topic, kind in TYPES_OF_ROBOT.items():
            graph.advertise(topic, kind)
        self._news = (
            graph.subscribe(COLOR, DEPTH, INFO, DEPTH_INFO, capacity=_WAITING),
            graph.subscribe(JOINTS, capacity=_WAITING_STATES),
            graph.subscribe(*TYPES_OF_ROBOT, capacity=_WAITING_STATES),
        )
        self._threads = [
            threading.Thread(target=self._run, args=(news,), name=f"ros-{name}", daemon=True)
            for news, name in zip(self._news, ("images", "joints", "robot"), strict=True)
        ]

    def start(self) -> None:
        """Begin."""
        for thread in self._threads:
            thread.start()

    def stop(self, timeout_s: float = 5.0) -> None:
        """End."""
        for news in self._news:
            news.close()
        join_started(self._threads, timeout_s)

    def _run(self, subscription: Subscription) -> None:
        for news in subscription:
            value: RosMessage = news.value
            if value.client == 0:
                continue
            try:
                self._take(news.topic, value)
            except BusyError:
                self.dropped += 1  # as a camera drops frames without a reader
            except SplatbotError as error:
                self._warn(news.topic, str(error))
            except Exception:  # one odd message must not end the others
                _log.exception("%s from a client could not be used", news.topic)

    def _warn(self, topic: str, problem: str) -> None:
        """Log a refused message; equal problems of a topic once in 10 s, with their count."""
        now, (last, since, count) = time.monotonic(), self._problems.get(topic, ("", 0.0, 0))
        if problem == last and now - since < _WARN_EVERY_S:
            self._problems[topic] = last, since, count + 1
            return
        more = f" ({count} more before)" if count else ""
        _log.warning("%s from a client: %s%s", topic, problem, more)
        self._problems[topic] = problem, now, 0

    def _take(self, topic: str, value: RosMessage) -> None:
        if topic == JOINTS:
            self._on_joints(joints_of(value.message))
        elif topic in TYPES_OF_ROBOT:
            self._on_robot(topic, value.message)
        elif self._on_frame is not None and (frame := self._pairs.add(topic, value.message)) is not None:
            self._on_frame(frame)


class FramePairs:
    """Colour and depth images as they come, paired by time.

    Args:
        max_pixels: of an image; larger ones are refused before anything is decoded or allocated.
        find_transform: of TF, for depth of another camera than colour.
    """

    def __init__(
        self, max_pixels: int = MAX_PIXELS, find_transform: FindTransform = lambda target, source: None
    ) -> None:
        self._max_pixels = max_pixels
        self._cameras = RosCameras(find_transform)
        self._waiting: dict[str, OrderedDict[float, Any]] = {COLOR: OrderedDict(), DEPTH: OrderedDict()}
        self._count = 0

    def add(self, topic: str, message: Any) -> Frame | None:
        """Add an image and return the frame that it completes, if any.

        Raises:
            InputError: the image or the intrinsics make no sense, or do not belong together.
            TooLargeError: the image has too many pixels.
        """
        if topic in (INFO, DEPTH_INFO):
            camera = camera_of(message)
            self._check_size(camera.width, camera.height)
            if topic == INFO:
                self._cameras.color = camera
            else:
                self._cameras.set_depth(camera, message.header.frame_id.strip("/"))
            return None
        self._check_size(*size_of(message))
        stamp, other = seconds_of(message.header.stamp), self._waiting[DEPTH if topic == COLOR else COLOR]
        nearest = min(other, key=lambda known: abs(known - stamp), default=None)
        if self._cameras.color is None or nearest is None or abs(nearest - stamp) > MAX_STAMP_DIFFERENCE_S:
            self._waiting[topic][stamp] = message
            while len(self._waiting[topic]) > _WAITING:
                self._waiting[topic].popitem(last=False)
            return None
        partner = other.pop(nearest)
        color, depth = (message, partner) if topic == COLOR else (partner, message)
        return self._frame(seconds_of(color.header.stamp), color, depth)

    def _check_size(self, width: int, height: int) -> None:
        if width * height > self._max_pixels:
            hint = "publish smaller images, or raise SPLATBOT_MAX_PIXELS"
            raise TooLargeError(
                f"{width}x{height} has more than {self._max_pixels} pixels.", field="width, height", hint=hint
            )

    def _frame(self, stamp: float, color: Any, depth: Any) -> Frame:
        color_frame, depth_frame = (message.header.frame_id.strip("/") for message in (color, depth))
        colors, depths = color_of(color), depth_of(depth)
        pair = self._cameras.pair(color_frame, depth_frame, same_size=colors.shape[:2] == depths.shape)
        rgb, z = pair.images(colors, depths)
        self._count += 1
        return RosFrame(
            stamp,
            rgb,
            z,
            pair.camera,
            self._count - 1,
            source=FROM_ROS,
            depth_delay=seconds_of(depth.header.stamp) - stamp,
            camera_frame=depth_frame or color_frame,
        )
