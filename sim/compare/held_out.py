"""The held-out twin: true shapes, and physics that differs from that of the map's twin in each trial."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import mujoco
import numpy as np

from splatbot.protocols import Array
from splatbot.sim.effects.physics import PHYSICS
from splatbot.sim.scene import Scene, make_scene
from splatbot.sim.twin import Twin

Range = tuple[float, float]


@dataclass(frozen=True)
class Spread:
    """Ranges of the held-out physics, each drawn uniformly unless stated otherwise.

    Args:
        friction: factor of every friction coefficient.
        mass: factor of every movable object's mass.
        gain: factor of the drives' stiffness and damping; the controller does not know it.
        lag: time constant of the drives [s].
        latency: of commands [s].
        joint_friction: fraction of the torque limits.
        backlash: [rad].
        base: standard deviation of the normally distributed base position error, per axis [m].
        yaw: standard deviation of the normally distributed base yaw error [rad].
        impratio: of the contacts, drawn log-uniformly. If None, the settings of contacts are those of the effects.
        softness: time constant of the objects' contacts [s]; MuJoCo's default is 0.02.
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
    impratio: Range | None = None
    softness: Range = (0.004, 0.02)


@dataclass(frozen=True)
class ContactEngine:
    """MuJoCo's settings of contacts in one held-out twin; cone and solver are drawn with equal probability.

    Args:
        pyramidal: whether friction cones are pyramids.
        solver: index of MuJoCo's solver: 1 conjugate gradient, 2 Newton.
        impratio: ratio of the impedances of friction and normal forces. Lower ones let objects creep.
        softness: time constant of the objects' contacts [s].
    """

    pyramidal: bool
    solver: int
    impratio: float
    softness: float


@dataclass(frozen=True)
class HeldOutPhysics:
    """One draw of :class:`Spread`.

    Args:
        friction, mass, gain: factors.
        lag, latency: [s].
        joint_friction: fraction of the torque limits.
        backlash: [rad].
        base: position error (x, y, z) [m].
        yaw: yaw error [rad].
        engine: settings of contacts. If None, those of the effects.
    """

    friction: float
    mass: float
    gain: float
    lag: float
    latency: float
    joint_friction: float
    backlash: float
    base: tuple[float, float, float]
    yaw: float
    engine: ContactEngine | None = None


def draw(spread: Spread, seed: int) -> HeldOutPhysics:
    """Draw the physics of one trial; the same seed gives the same physics."""
    rng = np.random.default_rng(seed)
    names = ("friction", "mass", "gain", "lag", "latency", "joint_friction", "backlash")
    values = {name: float(rng.uniform(*getattr(spread, name))) for name in names}
    x, y, z = (spread.base * rng.standard_normal(3)).tolist()
    yaw = spread.yaw * float(rng.standard_normal())
    engine = None
    if spread.impratio is not None:
        impratio = float(np.exp(rng.uniform(*np.log(spread.impratio))))
        pyramidal, solver = bool(rng.random() < 0.5), int(rng.integers(1, 3))
        engine = ContactEngine(pyramidal, solver, impratio, float(rng.uniform(*spread.softness)))
    return HeldOutPhysics(**values, base=(x, y, z), yaw=yaw, engine=engine)


def held_out_scene(scene: Scene, physics: HeldOutPhysics) -> Scene:
    """Return the scene with that physics and all effects enabled."""
    values = scene.model_dump()
    for obj in values["objects"]:
        obj["friction"] *= physics.friction
        if obj["movable"]:
            obj["mass"] = (obj["mass"] or 0.2) * physics.mass
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
    """A twin whose drives differ from the controller's model and receive commands command.

    Args:
        scene: with the true shapes.
        physics: the deviation from nominal physics.
        seed: as in :class:`splatbot.sim.twin.Twin`.
    """

    def __init__(self, scene: Scene, physics: HeldOutPhysics, *, seed: int = 0) -> None:
        self.physics = physics
        self._delayed: deque[tuple[Array, Array, Array, float | None]] = deque()
        super().__init__(held_out_scene(scene, physics), seed=seed)
        self._periods = round(physics.latency * self.rate)
        if physics.engine is not None:
            self._set_engine(physics.engine)
        if self.follower is not None and self.world.robot is not None:
            model = self.world.model
            motors = [int(model.actuator(name).id) for name in self.world.robot.chain.names]
            model.actuator_gainprm[motors, 0] *= physics.gain
            model.actuator_biasprm[motors, 1:3] *= physics.gain

    def _set_engine(self, engine: ContactEngine) -> None:
        model = self.world.model
        model.opt.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL if engine.pyramidal else mujoco.mjtCone.mjCONE_ELLIPTIC
        model.opt.solver, model.opt.impratio = engine.solver, engine.impratio
        # The finger pads keep the softness of the gripper's compliance.
        of_objects = ~self.world.of_robot
        model.geom_solref[of_objects, 0] = max(engine.softness, 2.0 * self.timestep)

    def reset(self, q: Array | None = None) -> None:
        """Reset the twin and discard the delayed commands."""
        self._delayed.clear()
        super().reset(q)

    def advance(self, time: float, q: Array, velocity: Array, acceleration: Array, opening: float | None) -> None:
        """Simulate one control period with the delayed command; before the latency has passed, with the first."""
        self._delayed.append((q, velocity, acceleration, opening))
        command = self._delayed[0]
        if len(self._delayed) > self._periods:
            self._delayed.popleft()
        super().advance(time, *command)
