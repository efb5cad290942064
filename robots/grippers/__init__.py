"""Robotiq's 2F on a serial port, one that is not there but speaks its bytes, and one without any line."""

from splatbot.robots.grippers.fake import FakeGripper
from splatbot.robots.grippers.fake_line import LineFaults
from splatbot.robots.grippers.fake_robotiq import FakeRobotiq
from splatbot.robots.grippers.robotiq import RobotiqGripper

__all__ = ["FakeGripper", "FakeRobotiq", "LineFaults", "RobotiqGripper"]
