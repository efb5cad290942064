"""Vision-language models that locate a named object in images, and the checks of their answers."""

from splatbot.grasping.vision.affordance import VisionAffordance
from splatbot.grasping.vision.endpoint import EndpointModel
from splatbot.grasping.vision.local import LocalModel
from splatbot.grasping.vision.models import VisionError, VisionModel, VisionTimeoutError

__all__ = ["EndpointModel", "LocalModel", "VisionAffordance", "VisionError", "VisionModel", "VisionTimeoutError"]
