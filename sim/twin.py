"""The twin: physics simulation of a planned motion in a scene before the robot moves."""

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
from splatbot.sim.contact_monitor import ClearanceMonitor, ContactEvent, ContactMonitor, MinimumClearance
from splatbot.sim.effects.decisions import EffectDecision
from splatbot.sim.effects.physics import Hook
from splatbot.sim.following import Follower, targets_of
from splatbot.sim.motion import JointMotion, home_of, motion_of
from splatbot.sim.object_monitor import ObjectMonitor
from splatbot.sim.scene import Scene
from splatbot.sim.world import World, build_world


@dataclass(frozen=True)
class TwinConstants:
    """Constants of a running twin.

    Args:
        clearance_period: [s] time between clearance computations.
        max_accurate_step: [s] contacts are visibly soft at longer steps.
        max_penetration: [m] largest penetration without a warning.
    """

    clearance_period: float = 0.02
    max_accurate_step: float = 0.008
    max_penetration: float = 0.005


CONSTANTS = TwinConstants()


_BAD = [int(getattr(mujoco.mjtWarning, f"mjWARN_{kind}")) for kind in ("BADQPOS", "BADQVEL", "BADQACC")]


@dataclass(frozen=True)
class Tracking:
    """Following error of the arm at the ends of the control periods.

    Args:
        rms, largest: over joints and time [rad or m].
        final: the largest at the end [rad or m].
        tcp: largest position error of the tool [m].
    """

    rms: float
    largest: float
    final: float
    tcp: float


@dataclass(frozen=True)
class TwinResult:
    """Result of a simulated run.

    Args:
        scene: name.
        duration: simulated time [s].
        steps: number of physics steps.
        timestep: [s].
        rate: of the controller [Hz].
        seconds: wall-clock time [s].
        physics_seconds: part of it in MuJoCo and in the effects [s].
        real_time: ratio of simulated to wall-clock time.
        tracking: following error. If None, there is no robot, or physics was unstable from the start.
        contacts: of the arm.
        clearance: minimum clearance of the arm, computed every 20 ms.
        dropped: objects that fell.
        moved: distance of each movable object from its start at the end [m].
        figures: observables of the effects, by name.
        decisions: on every effect.
        warnings: limits of validity.
        stopped: time of a requested stop [s]. If None, the motion was complete.
        digest: hash of the state in every control period: equal for bit-identical runs.
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
    contacts: tuple[ContactEvent, ...]
    clearance: MinimumClearance
    dropped: tuple[str, ...]
    moved: dict[str, float]
    figures: dict[str, float]
    decisions: tuple[EffectDecision, ...]
    warnings: tuple[str, ...]
    stopped: float | None
    digest: str
    notes: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return the result as values for JSON."""
        return asdict(self)


@dataclass
class _TwinLog:
    """Data that a run collects."""

    contacts: ContactMonitor
    clearance: ClearanceMonitor
    objects: ObjectMonitor
    errors: list[Array] = field(default_factory=list)
    digest: Any = field(default_factory=hashlib.sha256)
    overload: float = 0.0
    physics: float = 0.0


# MuJoCo would write every warning into a file in the working directory; results contain the relevant ones.
mujoco.set_mju_user_warning(lambda text: None)
atexit.register(mujoco.set_mju_user_warning, None)  # the callback must not outlive this module


class Twin:
    """Physics simulation of a scene with an arm that follows motions. Resets are exact; equal seeds give equal bits.

    Args:
        scene: see :mod:`splatbot.sim.scene`.
        robot: replaces the scene's robot.
        timestep: longest step [s]; replaces the scene's.
        seed: of the random displacement of movable objects; 0 for no displacement.
        jitter: standard deviation of that displacement, horizontal [m].

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
        self._requested_rate = self.rate
        if timestep is not None and timestep > 1.0 / self.rate:
            self.rate, self.substeps, self.timestep = 1.0 / timestep, 1, timestep
        self.world: World = build_world(scene, robot=robot, timestep=self.timestep)
        self.data = mujoco.MjData(self.world.model)
        self.follower = Follower(self.world) if self.world.robot is not None else None
        self._stop = False
        self.reset()

    @property
    def hooks(self) -> tuple[Hook, ...]:
        """Callbacks of the effects."""
        return self.world.hooks

    def reset(self, q: Array | None = None) -> None:
        """Reset the state, with the arm at rest at ``q`` (J,), by default at home."""
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
        """Simulate one control period from ``time`` [s], with the targets ``q`` (J,) at its end."""
        for hook in self.hooks:
            hook.on_step(self.data, time)
        if self.follower is not None:
            for hook in self.hooks:
                q = hook.on_targets(q)
            self.follower.command(self.data, q, velocity, acceleration, opening)
        mujoco.mj_step(self.world.model, self.data, self.substeps)

    def stop(self) -> None:
        """Stop the motion within one control period; callable from other threads and callbacks."""
        self._stop = True

    def follow(
        self,
        motion: JointMotion | None = None,
        *,
        progress: Callable[[float], None] | None = None,
        watch: Callable[[Any, float], None] | None = None,
        until_contact: bool = False,
    ) -> TwinResult:
        """Follow a motion from a reset.

        Args:
            motion: by default the moves of the scene's task.
            progress: called about fifty times with the completed fraction; may call :meth:`stop`.
            watch: called with MuJoCo's data and the time [s] after every control period; must not change the data.
            until_contact: stop at the first contact of the arm.

        Raises:
            InputError: the motion has another number of joints.
        """
        if motion is None:
            motion = self._own_motion()
        self._check(motion)
        self._stop = False
        self.reset(motion.position[0] if self.follower is not None else None)
        count = max(1, round(motion.duration * self.rate))
        log = _TwinLog(
            ContactMonitor(self.world),
            ClearanceMonitor(self.world),
            ObjectMonitor(self.world, self.data, 1.0 / self.rate),
        )
        begin = clock.perf_counter()
        done = self._run(motion, count, log, progress, watch, until_contact)
        return self._result(motion, done, count, log, clock.perf_counter() - begin)

    def _run(
        self,
        motion: JointMotion,
        count: int,
        log: _TwinLog,
        progress: Callable[[float], None] | None,
        watch: Callable[[Any, float], None] | None,
        until_contact: bool,
    ) -> int:
        period = 1.0 / self.rate
        q, v, a, opening = targets_of(motion, count, period)
        every, report_every = max(1, round(CONSTANTS.clearance_period * self.rate)), max(1, count // 50)
        limits = np.maximum(np.abs(self.world.model.actuator_forcerange).max(axis=1), 1e-9)
        log.clearance.update(self.data, 0.0)
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
            log.contacts.update(self.data, now)
            log.objects.update(self.data)
            log.digest.update(self.data.qpos.tobytes())
            if (k + 1) % every == 0:
                log.clearance.update(self.data, now)
            if progress is not None and (k + 1) % report_every == 0:
                progress((k + 1) / count)
            if self._stop or (until_contact and log.contacts.found):
                return k + 1
        return count

    def _result(self, motion: JointMotion, done: int, count: int, log: _TwinLog, seconds: float) -> TwinResult:
        simulated = done / self.rate
        tracking = self._tracking(motion, log, done) if self.follower is not None else None
        figures = {
            "contact_steps": float(log.contacts.steps),
            "tangential_n": log.contacts.tangential,
            "overload": log.overload,
            "tracking_rms": tracking.rms if tracking is not None else 0.0,
            "opening": self.follower.opening(self.data) if self.follower is not None else 0.0,
            "deformation": log.objects.deformation,
            "travelled": log.objects.travelled,
            "obstacle_travel": log.objects.obstacle_travel,
            "light": float(np.sum(self.world.model.light_diffuse))
            + float(self.world.model.vis.headlight.diffuse.sum()),
            "asleep": log.objects.asleep,
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
            contacts=tuple(log.contacts.found),
            clearance=log.clearance.minimum,
            dropped=log.objects.dropped,
            moved=log.objects.moved(self.data),
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
        reached, target = (self.world.robot.tcp(at[:: max(1, done // 200)])[:, :3, 3] for at in (q + errors, q))
        return Tracking(
            rms=float(np.sqrt(np.mean(errors**2))),
            largest=float(np.abs(errors).max()),
            final=float(np.abs(errors[-1]).max()),
            tcp=float(np.linalg.norm(reached - target, axis=-1).max()),
        )

    def _broken(self) -> bool:
        """Return whether MuJoCo reported invalid values or the state is not finite."""
        return any(self.data.warning[kind].number for kind in _BAD) or not np.isfinite(self.data.qpos).all()

    def _warnings(self, log: _TwinLog) -> tuple[str, ...]:
        found = []
        if self._broken():
            found.append(f"physics became unstable and was stopped: take steps below {1e3 * self.timestep:g} ms")
        if self.timestep > CONSTANTS.max_accurate_step and "contact" in self.world.on:
            found.append(f"steps of {1e3 * self.timestep:g} ms: contacts are too soft; use 2 ms")
        if self.rate < self._requested_rate:
            found.append(
                f"steps of {1e3 * self.timestep:g} ms: the controller runs at {self.rate:g} Hz, "
                f"not at {self._requested_rate:g}"
            )
        deepest = max((contact.depth for contact in log.contacts.found), default=0.0)
        if deepest > CONSTANTS.max_penetration:
            found.append(f"contacts overlap by {1e3 * deepest:.1f} mm: forces are inaccurate")
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
        for obj in self.scene.movable:
            address = int(self.world.model.body(f"object/{obj.name}").jntadr[0])
            at = int(self.world.model.jnt_qposadr[address])
            self.data.qpos[at : at + 2] += self._jitter * rng.standard_normal(2)
