"""rolled_back: a saved SLAM goes on as the next state of a map that has grown since."""

from __future__ import annotations

from splatbot.mapping.further_camera import FreeCamera
from splatbot.slam import Slam


def rolled_back(slam: Slam, map_version: int) -> Slam:
    """Return the SLAM of a saved state, ready for frames of a later time.

    The first camera and free cameras have moved since the state was saved, so their next frames may be anywhere in the
    map. Until a frame is found in it, frames are lost and change nothing. A pending loop closure is applied first, and
    the version of the map is then larger than ``map_version``.

    Args:
        slam: as loaded; it is changed.
        map_version: version of the map from here on, larger than every version that was published.
    """
    slam._mapper.version = map_version
    slam.close_loops()
    slam._tracker.forget()
    for camera in slam.further_cameras.values():
        if isinstance(camera, FreeCamera):
            camera.forget()
    return slam
