"""rolled_back: a saved SLAM goes on as the next state of a map that has grown since."""

from __future__ import annotations

from splatbot.slam import Slam


def rolled_back(slam: Slam, map_version: int) -> Slam:
    """Return the SLAM of a saved state, ready for frames of a later time.

    The camera has moved since the state was saved, so the next frame may be anywhere in the map. Until a frame is
    found in it, frames are lost and change nothing.

    Args:
        slam: as loaded; it is changed.
        map_version: version of the map from here on, larger than every version that was published.
    """
    slam._mapper.version = map_version
    slam.close_loops()
    slam._tracker.forget()
    return slam
