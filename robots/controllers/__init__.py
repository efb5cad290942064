"""Controllers without hardware: one follows its commands, the other a recorded motion."""

from splatbot.robots.controllers.fake import FakeController
from splatbot.robots.controllers.recorded import JointRecording, RecordedController

__all__ = ["FakeController", "JointRecording", "RecordedController"]
