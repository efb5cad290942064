"""A held-out twin: true shapes, and physics unlike what the map's twin assumes, drawn anew for each trial."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from splatbot.protocols import Array
from splatbot.sim.effects.physics import PHYSICS
from splatbot.sim.scene import Scene, make_scene
from splatbot.sim.twin import Twin

Range = tuple[float, float]


@dataclass(frozen=True)
class Spread:
    """How far the held-out physics may be from the nominal one; each is drawn evenly.

    Args:
        friction: factor of every coefficient.
        mass: factor of every movable object's mass.
        gain: factor of the drives' stiffness and damping, which the controller does not know of.
        lag: time constant of the drives [s].
        latency: of commands [s].
        joint_friction: as a share of the torque limits.
        backlash: [rad].
        base: standard deviation of where the base really is, in each direction [m]; ``yaw`` how it is turned [rad].
    """

    friction: Range = (0.35, 1.2)
    mass: Range = (0.5, 2.5)
    gain: Range = (0.7, 1.2)
    lag: Range = (0.0, 0.01)
    latency: Range = (0.0, 0.02)
    joint_friction: Range = (0.0, 0.01)
    backlash: Range = (0.0, 0.001)
    base: float = 0.001
    yaw: float = 0.001


@dataclass(frozen=True)
class HeldOutPhysics:
    """What was drawn of a :class:`Spread`; ``base`` is (x, y, z) [m] and ``yaw`` [rad] off."""

    friction: float
    mass: float
    gain: float
    lag: float
    latency: float
    joint_friction: float
    backlash: float
    base: tuple[float, float, float]
    yaw: float


def draw(spread: Spread, seed: int) -> HeldOutPhysics:
    """The physics of one trial; the same seed gives the same."""
    rng = np.random.default_rng(seed)
    names = ("friction", "mass", "gain", "lag", "latency", "joint_friction", "backlash")
    values = {name: float(rng.uniform(*getattr(spread, name))) for name in names}
    x, y, z = (spread.base * rng.standard_normal(3)).tolist()
    return HeldOutPhysics(**values, base=(x, y, z), yaw=spread.yaw * float(rng.standard_normal()))


def held_out_scene(scene: Scene, physics: HeldOutPhysics) -> Scene:
    """The scene with that physics, all effects on."""
    values = scene.model_dump()
    for thing in values["objects"]:
        thing["friction"] *= physics.friction
        if thing["movable"]:
            thing["mass"] = (thing["mass"] or 0.2) * physics.mass
    if scene.robot is not None:
        robot = values["robot"]
        robot["at"] = tuple(a + b for a, b in zip(robot["at"], physics.base, strict=True))
        robot["yaw"] += physics.yaw
        robot["motors"] |= {
            "lag": physics.lag,
            "friction": physics.joint_friction,
            "backlash": physics.backlash,
        }
    return make_scene({**values, "effects": {"force": PHYSICS}, "folder": scene.folder})


class HeldOutTwin(Twin):
    """A twin whose drives are weaker or stiffer than its controller knows, and hear commands late.

    Args:
        scene: of the true shapes.
        physics: what differs.
        seed: as of :class:`splatbot.sim.twin.Twin`.
    """

    def __init__(self, scene: Scene, physics: HeldOutPhysics, *, seed: int = 0) -> None:
        self.physics = physics
        self._late: deque[tuple[Array, Array, Array, float | None]] = deque()
        super().__init__(held_out_scene(scene, physics), seed=seed)
        self._periods = round(physics.latency * self.rate)
        if self.follower is not None and self.world.robot is not None:
            model = self.world.model
            motors = [int(model.actuator(name).id) for name in self.world.robot.chain.names]
            model.actuator_gainprm[motors, 0] *= physics.gain
            model.actuator_biasprm[motors, 1:3] *= physics.gain

    def reset(self, q: Array | None = None) -> None:
        """Also forgets the commands that are on their way."""
        self._late.clear()
        super().reset(q)

    def advance(self, time: float, q: Array, velocity: Array, acceleration: Array, opening: float | None) -> None:
        """One control period with the command of as many periods ago as commands are late; the first one until then."""
        self._late.append((q, velocity, acceleration, opening))
        late = self._late[0]
        if len(self._late) > self._periods:
            self._late.popleft()
        super().advance(time, *late)
