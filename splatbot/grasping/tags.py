"""Targets with an AprilTag."""

from __future__ import annotations

import cv2
import numpy as np

from splatbot.errors import InputError
from splatbot.grasping.affordance import AffordanceError, ObservedView, OneKindAffordance, TagHint, Target
from splatbot.grasping.spatial import at_point, point_at
from splatbot.protocols import Array
from splatbot.segmentation import SegmentedMap

FAMILIES = {
    "16h5": cv2.aruco.DICT_APRILTAG_16h5,
    "25h9": cv2.aruco.DICT_APRILTAG_25h9,
    "36h10": cv2.aruco.DICT_APRILTAG_36h10,
    "36h11": cv2.aruco.DICT_APRILTAG_36h11,
}


class TagAffordance(OneKindAffordance[TagHint]):
    """Finds the object with an AprilTag (Olson 2011): tag detection in images, depth from the map."""

    name = "apriltag"
    kind, wanted = TagHint, "a tag"

    def _find(self, hint: TagHint, scene: SegmentedMap) -> Target:
        seen: set[int] = set()
        for view in hint.views:
            corners = find_tags(view, hint.family)
            seen |= set(corners)
            if hint.number in corners:
                u, v = corners[hint.number].mean(axis=0)
                point = point_at(scene, view, float(u), float(v))
                return at_point(scene, point, backend=self.name, label=f"tag {hint.number}")
        numbers = ", ".join(map(str, sorted(seen))) or "none"
        raise AffordanceError(
            f"is in none of {len(hint.views)} pictures; these tags are: {numbers}.",
            field=f"tag {hint.number}",
            hint="name a tag that can be seen, or give more pictures",
            candidates=tuple(f"tag {k}" for k in sorted(seen)),
        )


def find_tags(view: ObservedView, family: str = "36h11") -> dict[int, Array]:
    """Detect tags in the image of a view; return their corners (4, 2) [px] by tag id.

    Raises:
        InputError: the family is unknown, or the view has no image.
    """
    if family not in FAMILIES:
        raise InputError(f"is {family!r}.", field="family", hint=f"one of {', '.join(FAMILIES)}")
    if view.rgb is None:
        raise InputError("has no picture.", field="view", hint="give the picture that the camera took")
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_APRILTAG
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(FAMILIES[family]), parameters)
    grey = cv2.cvtColor(np.ascontiguousarray(view.rgb), cv2.COLOR_RGB2GRAY)
    corners, numbers, _ = detector.detectMarkers(grey)
    if numbers is None:
        return {}
    return {int(n): c.reshape(4, 2).astype(np.float64) for n, c in zip(numbers.ravel(), corners, strict=True)}
