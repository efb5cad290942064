"""Grippers on serial lines and behind ROS, two that are not there but speak their bytes, and one without any line."""

from splatbot.robots.grippers.fake import FakeGripper
from splatbot.robots.grippers.fake_feetech import FakeFeetech
from splatbot.robots.grippers.fake_line import LineFaults
from splatbot.robots.grippers.fake_robotiq import FakeRobotiq
from splatbot.robots.grippers.feetech import FeetechGripper, JawCalibration
from splatbot.robots.grippers.robotiq import RobotiqGripper

__all__ = [
    "FakeFeetech",
    "FakeGripper",
    "FakeRobotiq",
    "FeetechGripper",
    "JawCalibration",
    "LineFaults",
    "RobotiqGripper",
]
