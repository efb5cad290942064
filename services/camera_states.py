"""Further cameras of a served map: their frames, and their poses as far as they are known."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from splatbot.mapping.further_camera import FurtherCamera
from splatbot.results.cameras import camera_metrics
from splatbot.slam import FrameResult

_NO_FRAMES: dict[str, Any] = {"frames": 0, "tracked": 0, "lost": 0, "keyframes": 0, "reason": None}


class CameraStates:
    """States of the further cameras of a map; the mapping thread writes them, and any thread reads them."""

    def __init__(self) -> None:
        self._states: dict[str, dict[str, Any]] = {}

    @property
    def by_name(self) -> Mapping[str, Mapping[str, Any]]:
        """Return the values of :func:`splatbot.results.cameras.camera_metrics`, and the number of lost frames.

        ``reason`` is that of the newest frame; None if the frame has a pose.
        """
        return self._states

    def update(self, cameras: Mapping[str, FurtherCamera], result: FrameResult | None = None) -> None:
        """Take the present poses of the cameras, and count the result of a frame of any camera."""
        states = {}
        for name, now in camera_metrics((), cameras).items():
            counts = {key: self._states.get(name, _NO_FRAMES)[key] for key in _NO_FRAMES}
            if result is not None and result.camera_name == name:
                counts = _counted(counts, result)
            states[name] = {"kind": now["kind"], **counts, "pose": now["pose"]}
        self._states = states


def _counted(counts: Mapping[str, Any], result: FrameResult) -> dict[str, Any]:
    lost = result.verdict == "lost"
    return {
        "frames": counts["frames"] + 1,
        "tracked": counts["tracked"] + (not lost),
        "lost": counts["lost"] + lost,
        "keyframes": counts["keyframes"] + result.keyframe,
        "reason": "; ".join(result.reasons) if lost else None,
    }
