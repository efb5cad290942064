"""Grippers without hardware."""

from splatbot.robots.grippers.fake import FakeGripper

__all__ = ["FakeGripper"]
