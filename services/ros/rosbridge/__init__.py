"""rosbridge v2 (RobotWebTools/rosbridge_suite, ROSBRIDGE_PROTOCOL.md) without ROS."""

from splatbot.services.ros.rosbridge.session import RosbridgeSession

__all__ = ["RosbridgeSession"]
