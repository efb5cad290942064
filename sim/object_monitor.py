"""Motion of the scene's objects while the twin runs."""

from __future__ import annotations

from typing import Any

import numpy as np

from splatbot.protocols import Array
from splatbot.sim.world import OBJECT, World

_FALL_SPEED = 0.7  # [m/s]; above the speed of placing, and reached after a fall of 2.5 cm


class ObjectMonitor:
    """Monitors movable, carried and soft objects."""

    def __init__(self, world: World, data: Any, period: float) -> None:
        scene, m = world.scene, world.model
        self._names = [obj.name for obj in scene.movable]
        self._bodies = [int(m.body(OBJECT + name).id) for name in self._names]
        carried = [int(m.body(OBJECT + obj.name).id) for obj in scene.carried]
        self._carried = carried
        self._trees = np.asarray(m.body_treeid)[self._bodies] if self._bodies else np.zeros(0, int)
        self._soft = m.nflexvert > 0
        self._start = self._at(data, self._bodies)
        self._last, self._last_carried = self._start, self._at(data, carried)
        self._fall = _FALL_SPEED * period
        self._fell = np.zeros(len(self._bodies), dtype=np.bool_)
        self._shape = self._spread(data)
        self.travelled = self.obstacle_travel = self.deformation = 0.0
        self._awake = self._samples = 0

    def update(self, data: Any) -> None:
        """Record the current positions."""
        if self._bodies:
            at = self._at(data, self._bodies)
            self.travelled += float(np.linalg.norm(at - self._last, axis=1).sum())
            self._fell |= self._last[:, 2] - at[:, 2] > self._fall
            self._last = at
            self._awake += int(np.asarray(data.tree_awake)[self._trees].sum())
            self._samples += len(self._bodies)
        if self._carried:
            at = self._at(data, self._carried)
            self.obstacle_travel += float(np.linalg.norm(at - self._last_carried, axis=1).sum())
            self._last_carried = at
        if self._soft:
            self.deformation = max(self.deformation, float(np.abs(self._spread(data) - self._shape).max()))

    @property
    def asleep(self) -> float:
        """Mean fraction of the movable objects that slept; 0 without any."""
        return 1.0 - self._awake / self._samples if self._samples else 0.0

    @property
    def dropped(self) -> tuple[str, ...]:
        """Objects that fell by 2.5 cm or more."""
        return tuple(name for name, fell in zip(self._names, self._fell, strict=True) if fell)

    def moved(self, data: Any) -> dict[str, float]:
        """Return the distance of each movable object from its start [m]."""
        away = np.linalg.norm(self._at(data, self._bodies) - self._start, axis=1)
        return dict(zip(self._names, away.tolist(), strict=True))

    def _at(self, data: Any, bodies: list[int]) -> Array:
        return np.array(data.xpos)[bodies].reshape(-1, 3)

    def _spread(self, data: Any) -> Array:
        """Compute the distances of soft bodies' vertices from their centre (V,) [m]; rigid motion keeps them."""
        if not self._soft:
            return np.zeros(0)
        at = np.array(data.flexvert_xpos)
        return np.asarray(np.linalg.norm(at - at.mean(axis=0), axis=1))
