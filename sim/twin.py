"""The twin: a planned motion is tried in a scene's physics before the robot moves."""

from __future__ import annotations

import atexit
import hashlib
import time as clock
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Any

import mujoco
import numpy as np

from splatbot.errors import InputError
from splatbot.protocols import Array
from splatbot.robots.robot import RobotModel
from splatbot.sim.contact_monitor import ContactMonitor, Near, Room, Touch
from splatbot.sim.effects.decisions import EffectDecision
from splatbot.sim.effects.physics import Hook
from splatbot.sim.following import Follower, targets_of
from splatbot.sim.motion import JointMotion, home_of, motion_of
from splatbot.sim.object_monitor import ObjectMonitor
from splatbot.sim.scene import Scene
from splatbot.sim.world import World, build_world

_ROOM_EVERY = 0.02  # [s] between looks at the room around the arm
_SOFT_CONTACTS = 0.008  # [s]; with longer steps contacts give way visibly
_BAD = [int(getattr(mujoco.mjtWarning, f"mjWARN_{kind}")) for kind in ("BADQPOS", "BADQVEL", "BADQACC")]
_DEEP = 0.005  # [m] of overlap that a result warns of


@dataclass(frozen=True)
class Tracking:
    """How far the arm was from where it should have been at the ends of the control periods.

    Args:
        rms, largest: over joints and time [rad or m].
        final: the largest at the end [rad or m].
        tcp: largest distance of the tool from its place [m].
    """

    rms: float
    largest: float
    final: float
    tcp: float


@dataclass(frozen=True)
class TwinResult:
    """What happened.

    Args:
        scene: its name.
        duration: [s] of the motion.
        steps: of physics; ``timestep`` [s] each.
        timestep: [s].
        rate: of the controller [Hz].
        seconds: that it took [s].
        physics_seconds: of it in MuJoCo and in the effects [s].
        real_time: simulated over real time.
        tracking: None without a robot, or where physics was unstable from the first.
        touches: what the arm touched.
        near: the least room around the arm, looked at every 20 ms.
        dropped: objects that fell.
        moved: how far each movable object ended from where it began [m].
        figures: observables of the effects, by name.
        decisions: on every effect.
        warnings: where not to trust it.
        stopped: [s] at which it was told to stop; None: never.
        digest: of the state in every control period: equal for equal bits.
    """

    scene: str
    duration: float
    steps: int
    timestep: float
    rate: float
    seconds: float
    physics_seconds: float
    real_time: float
    tracking: Tracking | None
    touches: tuple[Touch, ...]
    near: Near
    dropped: tuple[str, ...]
    moved: dict[str, float]
    figures: dict[str, float]
    decisions: tuple[EffectDecision, ...]
    warnings: tuple[str, ...]
    stopped: float | None
    digest: str
    notes: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """As JSON takes it."""
        return asdict(self)


@dataclass
class _TwinLog:
    """What a run gathers."""

    touches: ContactMonitor
    room: Room
    things: ObjectMonitor
    errors: list[Array] = field(default_factory=list)
    digest: Any = field(default_factory=hashlib.sha256)
    overload: float = 0.0
    physics: float = 0.0


# MuJoCo would write every warning into a file in the working directory; results carry what matters of them.
mujoco.set_mju_user_warning(lambda text: None)
atexit.register(mujoco.set_mju_user_warning, None)  # else it outlives the modules that it refers to


class Twin:
    """A scene's physics, and an arm in it that follows motions. Resets are exact; the same seed gives the same bits.

    Args:
        scene: see :mod:`splatbot.sim.scene`.
        robot: instead of the scene's.
        timestep: longest step [s], instead of the scene's: accuracy for time.
        seed: displaces movable objects by ``jitter``; 0 leaves them where the scene says.
        jitter: standard deviation of that displacement, sideways [m].

    Raises:
        ConfigError: the scene cannot be built.
        InputError: the robot is unknown.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        robot: RobotModel | None = None,
        timestep: float | None = None,
        seed: int = 0,
        jitter: float = 0.002,
    ) -> None:
        if timestep is not None and not 0 < timestep <= 0.05:
            raise InputError(f"is {timestep}.", field="timestep", hint="give seconds in 0..0.05")
        self.scene, self.seed, self._jitter = scene, seed, jitter
        longest = scene.timestep if timestep is None else timestep
        self.rate = scene.robot.motors.rate if scene.robot is not None else 1.0 / longest
        # A controller slower than physics takes several steps; one that is faster shortens them.
        self.substeps = max(1, int(np.ceil(1.0 / (self.rate * longest) - 1e-9)))
        self.timestep = 1.0 / (self.rate * self.substeps)
        self._asked_rate = self.rate
        if timestep is not None and timestep > 1.0 / self.rate:
            self.rate, self.substeps, self.timestep = 1.0 / timestep, 1, timestep
        self.world: World = build_world(scene, robot=robot, timestep=self.timestep)
        self.data = mujoco.MjData(self.world.model)
        self.follower = Follower(self.world) if self.world.robot is not None else None
        self._stop = False
        self.reset()

    @property
    def hooks(self) -> tuple[Hook, ...]:
        """Of the effects that act while it runs."""
        return self.world.hooks

    def reset(self, q: Array | None = None) -> None:
        """Everything as at the beginning, the arm at rest at ``q`` (J,), by default at home."""
        mujoco.mj_resetData(self.world.model, self.data)
        for hook in self.hooks:
            hook.reset()
            hook.on_step(self.data, 0.0)
        self._displace()
        if self.follower is not None and self.world.robot is not None:
            gripper = self.world.robot.gripper
            at = home_of(self.scene, self.world.robot) if q is None else self.world.robot.configurations(q)
            self.follower.place(self.data, at, 2 * gripper.stroke if gripper is not None else None)
            mujoco.mj_forward(self.world.model, self.data)
            still = np.zeros(len(at))
            self.follower.command(self.data, at, still, still, None)
            self.follower.settle_lag(self.data)
        mujoco.mj_forward(self.world.model, self.data)

    def advance(self, time: float, q: Array, velocity: Array, acceleration: Array, opening: float | None) -> None:
        """One control period that begins at ``time`` [s], at whose end the arm shall be at ``q`` (J,)."""
        for hook in self.hooks:
            hook.on_step(self.data, time)
        if self.follower is not None:
            for hook in self.hooks:
                q = hook.on_targets(q)
            self.follower.command(self.data, q, velocity, acceleration, opening)
        mujoco.mj_step(self.world.model, self.data, self.substeps)

    def stop(self) -> None:
        """Ends the motion that another thread, or a callback, follows, within one control period."""
        self._stop = True

    def follow(
        self,
        motion: JointMotion | None = None,
        *,
        progress: Callable[[float], None] | None = None,
        watch: Callable[[Any, float], None] | None = None,
        until_touch: bool = False,
    ) -> TwinResult:
        """Follow a motion from a reset.

        Args:
            motion: by default the moves of the scene's task.
            progress: called about fifty times with the share that is done; may call :meth:`stop`.
            watch: called with MuJoCo's data and the time [s] after every control period, to look and not to touch.
            until_touch: stop when the arm touches anything.

        Raises:
            InputError: the motion is of another robot.
        """
        if motion is None:
            motion = self._own_motion()
        self._check(motion)
        self._stop = False
        self.reset(motion.position[0] if self.follower is not None else None)
        count = max(1, round(motion.duration * self.rate))
        log = _TwinLog(
            ContactMonitor(self.world), Room(self.world), ObjectMonitor(self.world, self.data, 1.0 / self.rate)
        )
        begin = clock.perf_counter()
        done = self._run(motion, count, log, progress, watch, until_touch)
        return self._result(motion, done, count, log, clock.perf_counter() - begin)

    def _run(
        self,
        motion: JointMotion,
        count: int,
        log: _TwinLog,
        progress: Callable[[float], None] | None,
        watch: Callable[[Any, float], None] | None,
        until_touch: bool,
    ) -> int:
        period = 1.0 / self.rate
        q, v, a, opening = targets_of(motion, count, period)
        every, tell = max(1, round(_ROOM_EVERY * self.rate)), max(1, count // 50)
        limits = np.maximum(np.abs(self.world.model.actuator_forcerange).max(axis=1), 1e-9)
        log.room.look(self.data, 0.0)
        for k in range(count):
            now = (k + 1) * period
            start = clock.perf_counter()
            self.advance(k * period, q[k], v[k], a[k], None if opening is None else float(opening[k]))
            log.physics += clock.perf_counter() - start
            if self._broken():
                return k
            if watch is not None:
                watch(self.data, now)
            if self.follower is not None:
                log.errors.append(self.data.qpos[self.follower.qpos] - q[k])
                log.overload = max(log.overload, float((np.abs(self.data.actuator_force) / limits).max()))
            log.touches.look(self.data, now)
            log.things.look(self.data)
            log.digest.update(self.data.qpos.tobytes())
            if (k + 1) % every == 0:
                log.room.look(self.data, now)
            if progress is not None and (k + 1) % tell == 0:
                progress((k + 1) / count)
            if self._stop or (until_touch and log.touches.found):
                return k + 1
        return count

    def _result(self, motion: JointMotion, done: int, count: int, log: _TwinLog, seconds: float) -> TwinResult:
        simulated = done / self.rate
        tracking = self._tracking(motion, log, done) if self.follower is not None else None
        figures = {
            "contact_steps": float(log.touches.steps),
            "tangential_n": log.touches.tangential,
            "overload": log.overload,
            "tracking_rms": tracking.rms if tracking is not None else 0.0,
            "opening": self.follower.opening(self.data) if self.follower is not None else 0.0,
            "deformation": log.things.deformation,
            "travelled": log.things.travelled,
            "obstacle_travel": log.things.obstacle_travel,
            "light": float(np.sum(self.world.model.light_diffuse))
            + float(self.world.model.vis.headlight.diffuse.sum()),
            "asleep": log.things.asleep,
            "harmonics": float(self.world.harmonics),
        }
        return TwinResult(
            scene=self.scene.name,
            duration=simulated,
            steps=done * self.substeps,
            timestep=self.timestep,
            rate=self.rate,
            seconds=seconds,
            physics_seconds=log.physics,
            real_time=simulated / max(seconds, 1e-9),
            tracking=tracking,
            touches=tuple(log.touches.found),
            near=log.room.least,
            dropped=log.things.dropped,
            moved=log.things.moved(self.data),
            figures=figures,
            decisions=self.world.decisions,
            warnings=self._warnings(log),
            stopped=simulated if done < count else None,
            digest=log.digest.hexdigest(),
            notes=self.world.notes,
        )

    def _tracking(self, motion: JointMotion, log: _TwinLog, done: int) -> Tracking | None:
        assert self.world.robot is not None
        errors = np.array(log.errors)
        if not len(errors):
            return None
        q = motion.at(np.arange(1, done + 1) / self.rate)[0]
        reached, wanted = (self.world.robot.tcp(at[:: max(1, done // 200)])[:, :3, 3] for at in (q + errors, q))
        return Tracking(
            rms=float(np.sqrt(np.mean(errors**2))),
            largest=float(np.abs(errors).max()),
            final=float(np.abs(errors[-1]).max()),
            tcp=float(np.linalg.norm(reached - wanted, axis=-1).max()),
        )

    def _broken(self) -> bool:
        """Whether MuJoCo met values that are not finite or beyond all bounds, and began anew or went on with them."""
        return any(self.data.warning[kind].number for kind in _BAD) or not np.isfinite(self.data.qpos).all()

    def _warnings(self, log: _TwinLog) -> tuple[str, ...]:
        found = []
        if self._broken():
            found.append(f"physics became unstable and was stopped: take steps below {1e3 * self.timestep:g} ms")
        if self.timestep > _SOFT_CONTACTS and "contact" in self.world.on:
            found.append(f"steps of {1e3 * self.timestep:g} ms: contacts give way; 2 ms are right")
        if self.rate < self._asked_rate:
            found.append(
                f"steps of {1e3 * self.timestep:g} ms: the controller runs at {self.rate:g} Hz, "
                f"not at {self._asked_rate:g}"
            )
        deepest = max((touch.depth for touch in log.touches.found), default=0.0)
        if deepest > _DEEP:
            found.append(f"contacts overlap by {1e3 * deepest:.1f} mm: forces are rough")
        return tuple(found)

    def _own_motion(self) -> JointMotion:
        if self.world.robot is not None:
            return motion_of(self.scene, self.world.robot)
        still = np.zeros((2, 0))
        return JointMotion(np.array([0.0, 2.0]), still, still, still)

    def _check(self, motion: JointMotion) -> None:
        joints = len(self.world.robot) if self.world.robot is not None else 0
        if motion.position.shape[1] != joints:
            raise InputError(
                f"moves {motion.position.shape[1]} joints; the robot has {joints}.",
                field="motion",
                hint="give a trajectory of the scene's robot",
            )

    def _displace(self) -> None:
        if self.seed == 0 or self._jitter == 0:
            return
        rng = np.random.default_rng(self.seed)
        for thing in self.scene.movable:
            address = int(self.world.model.body(f"object/{thing.name}").jntadr[0])
            at = int(self.world.model.jnt_qposadr[address])
            self.data.qpos[at : at + 2] += self._jitter * rng.standard_normal(2)
