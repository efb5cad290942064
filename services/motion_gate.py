"""Gate of every motion: certified where and when it is executed, and again while the map changes."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatbot.collision import RobotSpheres
from splatbot.errors import MapNotFoundError, SplatbotError
from splatbot.planning import CertifiedMotion, MotionRefusedError, certify_motion
from splatbot.planning.certify import JointCurve
from splatbot.robots.joint_offsets import robot_in_scene
from splatbot.robots.robot import RobotModel
from splatbot.services.store import MapStore, ServedMap

_SAME_POSE = 1e-6  # [m and 1] largest difference between the elements of two poses that count as equal
_MAX_DURATION_S = 600.0
_WATCH_PERIOD_S = 0.02

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class MotionRequest:
    """Motion with the robot, the base and the map that it was made for.

    Args:
        motion: the curve.
        robot: name of the model.
        map_id: map in which it is executed.
        generation: of that map; another one of the same name has another generation.
        T_world_base: (4, 4) base that the motion was made for [m]. If None, the base of the map.
        margin: clearance to keep [m].
    """

    motion: JointCurve
    robot: str
    map_id: str
    generation: int
    T_world_base: NDArray[np.float64] | None = None
    margin: float = 0.0


class MotionGate:
    """Certifies motions in the maps of a store.

    Args:
        store: the maps.
    """

    def __init__(self, store: MapStore) -> None:
        self._store = store

    def certify(self, request: MotionRequest, robot: RobotModel) -> CertifiedMotion:
        """Certify a motion for an arm in the current version of its map.

        Args:
            request: the motion.
            robot: model of the arm that will execute it.

        Raises:
            MotionRefusedError: the motion was made for another robot, base or map, is too long, or is not certified.
        """
        if request.robot != robot.name:
            hint = f"plan for {robot.name}"
            raise MotionRefusedError(
                f"was made for {request.robot}, the arm is a {robot.name}.", field="robot", hint=hint
            )
        if not request.motion.duration <= _MAX_DURATION_S:
            raise MotionRefusedError(f"takes more than {_MAX_DURATION_S:g} s.", field="motion", hint="send it in parts")
        served = self.current(request)
        base = arm_base(served)
        if request.T_world_base is not None and np.abs(request.T_world_base - base).max() > _SAME_POSE:
            hint = "plan without `base`, or correct the base of the map"
            raise MotionRefusedError("was made for another base than the arm's.", field="base", hint=hint)
        arm = RobotSpheres(robot_in_scene(robot, served.workspace), T_world_base=base, margin=request.margin)
        return certify_motion(request.motion, arm, served.field)

    def current(self, request: MotionRequest) -> ServedMap:
        """Return the current version of the map of a motion.

        Raises:
            MotionRefusedError: the map was deleted, or another one has its name.
        """
        try:
            served = self._store.get(request.map_id)
        except MapNotFoundError as error:
            text = f"was made in map {request.map_id!r}, which no longer exists."
            raise MotionRefusedError(text, field="map", hint="plan in a map that is served") from error
        if served.generation != request.generation:
            text = f"was made in an earlier map of the name {request.map_id!r}."
            raise MotionRefusedError(text, field="map", hint="plan again")
        return served


class MotionWatch:
    """Certifies the rest of a motion again in each later version of its map, in a thread of its own.

    Args:
        gate: gives the current map.
        request: motion as it was sent.
        motion: as certified when it was sent.
        time: returns the time since the start of the motion [s].

    Attributes:
        refused: reason to stop, empty while the motion is certified.
    """

    def __init__(
        self, gate: MotionGate, request: MotionRequest, motion: CertifiedMotion, time: Callable[[], float]
    ) -> None:
        self.refused = ""
        self._gate, self._request, self._motion, self._time = gate, request, motion, time
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="motion-watch", daemon=True)

    def __enter__(self) -> MotionWatch:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()

    def _run(self) -> None:
        while not self.refused and not self._ended.wait(_WATCH_PERIOD_S):
            try:
                self._check()
            except SplatbotError as error:
                self.refused = str(error)
            except Exception:
                _log.exception("a motion could not be certified again")
                self.refused = "the motion could not be certified again; the service's log says why"

    def _check(self) -> None:
        served = self._gate.current(self._request)
        if served.map_version == self._motion.map_version:
            return
        base = arm_base(served)
        if np.abs(base - self._motion.arm.T_world_base).max() > _SAME_POSE:
            raise MotionRefusedError("was certified at another base.", field="base", hint="plan again")
        self._motion = self._motion.recertified(served.field, time=self._time())


def arm_base(served: ServedMap) -> NDArray[np.float64]:
    """Return the base T_world_base (4, 4) of the arms in a map.

    Raises:
        MotionRefusedError: it is unknown.
    """
    known = served.workspace.T_world_base if served.workspace is not None else None
    if known is None:
        hint = "create the map with robot_base, or write a scene.yaml next to it: splatbot info MAP --fit-plane"
        raise MotionRefusedError(f"of the arm in map {served.id!r} is unknown.", field="base", hint=hint)
    return known
