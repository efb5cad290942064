"""Vision-language models that say where a named thing is, and what it takes to believe them."""

from splatbot.grasping.vision.affordance import VisionAffordance
from splatbot.grasping.vision.endpoint import EndpointModel
from splatbot.grasping.vision.local import LocalModel
from splatbot.grasping.vision.models import VisionError, VisionModel, VisionTimeoutError

__all__ = ["EndpointModel", "LocalModel", "VisionAffordance", "VisionError", "VisionModel", "VisionTimeoutError"]
