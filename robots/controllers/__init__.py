"""Controllers without hardware: one follows its trajectory, one replays a recording."""

from splatbot.robots.controllers.fake import FakeController
from splatbot.robots.controllers.recorded import JointRecording, RecordedController

__all__ = ["FakeController", "JointRecording", "RecordedController"]
