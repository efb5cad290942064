"""The emergency stop for ROS clients: a topic and a service."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

from splatbot.logs.ros_types import Message
from splatbot.services.arms import Arms
from splatbot.services.ros.graph import Handler, RosGraph, Service

EMERGENCY_STOP = "/emergency_stop"


class EmergencyStopTopic:
    """Stops every arm at a message on /emergency_stop, or a call of the service of that name.

    The message is std_msgs/Empty, or a std_msgs/Bool that is true. Neither waits behind other work.

    Args:
        graph: registers them.
        arms: that stop.
    """

    def __init__(self, graph: RosGraph, arms: Arms) -> None:
        self._arms = arms
        graph.on_command(EMERGENCY_STOP, ("std_msgs/msg/Empty", "std_msgs/msg/Bool"), self._command)
        graph.serve(EMERGENCY_STOP, Service("std_srvs/srv/Trigger", cast(Handler, self._call)))

    def _command(self, message: Message, client: int) -> None:
        if getattr(message, "data", True):
            self._arms.stop_all(f"ROS client {client}")

    async def _call(self, _: Mapping[str, Any]) -> dict[str, Any]:
        self._arms.stop_all("a ROS client")
        return {"success": True, "message": "all arms stop; DELETE /v1/stop ends the emergency stop"}
