"""Controllers without hardware: one that moves as told, one that moves as was recorded."""

from splatbot.robots.controllers.fake import FakeController
from splatbot.robots.controllers.recorded import JointRecording, RecordedController

__all__ = ["FakeController", "JointRecording", "RecordedController"]
