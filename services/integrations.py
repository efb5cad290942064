"""Integrations that run next to the HTTP service: ROS topics and services, Zenoh, a recorder, the viewer."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from splatbot.frame import Frame
from splatbot.logs.ros_cameras import FindTransform
from splatbot.services.access import Access
from splatbot.services.arms import Arms
from splatbot.services.ros.node import RosNode
from splatbot.services.ros.recorder import McapRecorder
from splatbot.services.ros.zenoh_bridge import ZenohBridge
from splatbot.services.settings import ServiceSettings
from splatbot.services.store import MapStore
from splatbot.services.topics import JointState
from splatbot.services.viewer.viewer import Viewer


class Integrations:
    """Begins and ends with the application.

    Args:
        settings: which of them there are.
        access: rights to open the viewer.
        store: the maps.
        arms: executes the motions that ROS clients send.
        on_frame: called with each frame that ROS clients publish.
        on_joints: called with the robot's name and its joints that ROS clients publish.
        find_transform: of the TF that ROS clients publish.

    Raises:
        InputError: the viewer's port is taken.
        ConfigError: Zenoh is not installed, or its router's address malformed.
    """

    def __init__(
        self,
        settings: ServiceSettings,
        access: Access,
        store: MapStore,
        arms: Arms,
        *,
        on_frame: Callable[[Frame], Any],
        on_joints: Callable[[str, JointState], Any],
        find_transform: FindTransform,
    ) -> None:
        self.ros = RosNode(
            store,
            arms=arms,
            robot=settings.robot or "panda",
            on_frame=on_frame,
            on_joints=on_joints,
            max_pixels=settings.max_pixels,
            find_transform=find_transform,
        )
        router = settings.zenoh_router
        self._zenoh = ZenohBridge(self.ros.graph, router, domain=settings.ros_domain) if router is not None else None
        self._record = settings.record
        self._recorder: McapRecorder | None = None
        port = settings.viewer_port  # it speaks no TLS: remote users need a tunnel
        self.viewer = Viewer(store, access, host="127.0.0.1", port=port) if port is not None else None

    def start(self) -> None:
        """Begin.

        Raises:
            LogError: there is a recording of that name already.
        """
        self.ros.start()
        if self._zenoh is not None:
            self._zenoh.start()
        if self._record is not None:
            self._recorder = McapRecorder(self.ros.graph, self._record)
        if self.viewer is not None:
            self.viewer.start()

    def stop(self) -> None:
        """End; the recording is whole then."""
        if self._zenoh is not None:
            self._zenoh.stop()
        self.ros.stop()
        if self._recorder is not None:
            self._recorder.stop()
        if self.viewer is not None:
            self.viewer.stop()
