"""Camera trajectories through a scene: poses as exact float64 functions of time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from splatbot.errors import InputError
from splatbot.geometry import Array, look_at, so3_exp

Path = Callable[[float], Array]
"""T_world_camera (4, 4) at a time [s]."""

Point = tuple[float, float, float]


@dataclass(frozen=True)
class Stage:
    """Free space of the camera in a scene; z is up.

    Args:
        eye: default camera position [m].
        target: point at which the camera looks [m].
        ahead: free distance from ``eye`` towards ``target`` [m].
        circuit_center: centre of the free circle of circuits [m]; the camera faces outwards.
        circuit_radius: radius of that circle [m]. With 0, circuits move in front of ``target`` and face it.
        paths: names of the possible trajectories; empty for all.
    """

    eye: Point
    target: Point
    ahead: float
    circuit_center: Point = (0.0, 0.0, 0.0)
    circuit_radius: float = 0.0
    paths: tuple[str, ...] = ()

    @property
    def home(self) -> Array:
        """T_world_camera (4, 4) at ``eye``, facing ``target``."""
        return look_at(np.array(self.eye), np.array(self.target))


@dataclass(frozen=True)
class MotionOptions:
    """Parameters of a trajectory that do not depend on the scene.

    Args:
        duration: time from the first frame to the last [s].
        rate: frame rate [Hz].
        arc: angle of an orbit [rad].
        seed: seed of random motion.
    """

    duration: float
    rate: float = 30.0
    arc: float = np.radians(40.0)
    seed: int = 0


def make_path(name: str, stage: Stage, motion: MotionOptions) -> Path:
    """Create the trajectory ``name`` on a stage.

    Raises:
        InputError: the name is unknown, or the trajectory would collide with the scene.
    """
    if name not in TRAJECTORIES:
        raise InputError(f"there is no {name!r}.", field="trajectory", hint=f"trajectories: {', '.join(TRAJECTORIES)}")
    if stage.paths and name not in stage.paths:
        raise InputError(
            f"{name!r} does not fit into this scene.", field="trajectory", hint=f"take {', '.join(stage.paths)}"
        )
    return TRAJECTORIES[name](stage, motion)


def orbit(stage: Stage, motion: MotionOptions) -> Path:
    """Swing over an arc in front of the target in 8 s with a vertical oscillation.

    The motion is at most 0.5° and 8 mm per frame on a table top.
    """
    target, offset = np.array(stage.target), np.array(stage.eye) - np.array(stage.target)
    distance, middle = float(np.hypot(offset[0], offset[1])), np.arctan2(offset[1], offset[0])
    scale = distance / 0.80

    def pose(t: float) -> Array:
        azimuth = middle + 0.5 * motion.arc * np.sin(2 * np.pi * t / 8.0)
        radius = distance + 0.06 * scale * np.sin(2 * np.pi * t / 5.3)
        height = offset[2] + 0.05 * scale * np.sin(2 * np.pi * t / 6.7)
        eye = target + np.array([radius * np.cos(azimuth), radius * np.sin(azimuth), height])
        return look_at(eye, target + scale * np.array([-0.02, 0.03 * np.sin(2 * np.pi * t / 4.1), 0.04]))

    return pose


def arm(stage: Stage, _: MotionOptions) -> Path:
    """Move a wrist camera over 50 x 20 cm without a stop, with a period of 9 s and at most 0.25 m/s."""

    def pose(t: float) -> Array:
        w = 2 * np.pi * t / 9.0
        move = [0.25 * np.sin(w), 0.10 * np.sin(2 * w + 0.5), 0.06 * np.sin(w + 1.0)]
        return _moved(stage.home, move, np.radians([5 * np.sin(2 * w), 8 * np.sin(w), 4 * np.sin(w + 2.0)]))

    return pose


_STOPS = np.array(  # x, y, z [m] and rotation vector [deg] from home, in the camera frame
    [
        [-0.22, -0.08, 0.00, 3, 6, 0],
        [0.00, -0.10, 0.04, 5, 0, -3],
        [0.22, -0.08, 0.00, 3, -6, 0],
        [0.22, 0.08, 0.05, -4, -6, 4],
        [0.00, 0.10, 0.08, -5, 0, 0],
        [-0.22, 0.08, 0.05, -4, 6, -4],
    ]
)
_MOVE_S, _REST_S = 1.2, 0.4


def arm_stops(stage: Stage, _: MotionOptions) -> Path:
    """Move a wrist camera to six views with a stop of 0.4 s at each, by minimum jerk (Flash and Hogan 1985).

    With the normalized time s: x(s) = x0 + (x1 - x0) (10 s³ - 15 s⁴ + 6 s⁵).
    """

    def pose(t: float) -> Array:
        segment, since = divmod(t, _MOVE_S + _REST_S)
        fraction = _minimum_jerk(since / _MOVE_S)
        a, b = _STOPS[int(segment) % len(_STOPS)], _STOPS[(int(segment) + 1) % len(_STOPS)]
        at = a + fraction * (b - a)
        return _moved(stage.home, at[:3], np.radians(at[3:]))

    return pose


def handheld(stage: Stage, motion: MotionOptions) -> Path:
    """Simulate a handheld camera by random sway and jitter.

    Sway is 5 cm and 4° RMS at 0.05 to 0.4 Hz; jitter is 2 mm and 0.3° RMS at 0.5 to 6 Hz.
    """
    rng = np.random.default_rng([motion.seed, 1])
    sway = _band(rng, 0.05, 0.4, np.r_[np.full(3, 0.05), np.full(3, np.radians(4.0))])
    jitter = _band(rng, 0.5, 6.0, np.r_[np.full(3, 0.002), np.full(3, np.radians(0.3))])

    def pose(t: float) -> Array:
        at = sway(t) + jitter(t)
        return _moved(stage.home, at[:3], at[3:])

    return pose


def rotation(stage: Stage, _: MotionOptions) -> Path:
    """Rotate by 35° to both sides in 8 s with small pitch and roll; the camera centre does not move."""

    def pose(t: float) -> Array:
        yaw, nod = 35.0 * np.sin(2 * np.pi * t / 8.0), 8.0 * np.sin(2 * np.pi * t / 5.0)
        roll = 4.0 * np.sin(2 * np.pi * t / 3.7)
        T = stage.home
        T[:3, :3] = so3_exp([0, 0, np.radians(-yaw)]) @ T[:3, :3] @ so3_exp(np.radians([nod, 0, roll]))
        return T

    return pose


_TURN_RATE_DEG, _TURN_S = 120.0, 1.0


def turns(stage: Stage, _: MotionOptions) -> Path:
    """Turn away and back about the vertical, horizontal and optical axis in turn, 1 s each, at up to 120 °/s.

    The camera sways by 2 cm. The rates are those of a hand that turns a camera fast, as in TUM's fr1_rpy.
    """
    w = 2 * np.pi / _TURN_S
    amplitude = np.radians(_TURN_RATE_DEG) / w

    def pose(t: float) -> Array:
        turn, since = divmod(t, _TURN_S)
        angles = np.zeros(3)
        angles[(1, 0, 2)[int(turn) % 3]] = (-1) ** int(turn) * amplitude * (1.0 - np.cos(w * since))
        sway = [0.02 * np.sin(2.1 * t), 0.02 * np.sin(1.7 * t + 0.5) - 0.01, 0.02 * np.sin(1.3 * t)]
        return _moved(stage.home, sway, angles)

    return pose


_SNAP_DEG, _SNAP_S, _SNAP_PERIOD_S = 25.0, 0.2, 1.0


def snaps(stage: Stage, motion: MotionOptions) -> Path:
    """Turn by 25° within 0.2 s and back, once a second at a random time about a random axis: up to 234 °/s.

    A turn has minimum jerk. The camera sways by 2 cm and rests otherwise between turns, so that its velocity does not
    predict the next turn: the angular acceleration reaches 63 rad/s².
    """

    def pose(t: float) -> Array:
        number, since = divmod(t, _SNAP_PERIOD_S)
        rng = np.random.default_rng([motion.seed, 2, max(int(number), 0)])
        axis, begin = rng.normal(size=3), rng.uniform(0.1, 0.3)
        away, back = (_minimum_jerk((since - at) / _SNAP_S) for at in (begin, begin + 0.35))
        sway = [0.02 * np.sin(2.1 * t), 0.02 * np.sin(1.7 * t + 0.5) - 0.01, 0.02 * np.sin(1.3 * t)]
        return _moved(stage.home, sway, np.radians(_SNAP_DEG) * (away - back) * axis / np.linalg.norm(axis))

    return pose


def _minimum_jerk(s: float) -> float:
    """Return the fraction of a motion by minimum jerk at the normalized time ``s``; 0 before it and 1 after it."""
    s = min(max(s, 0.0), 1.0)
    return s**3 * (10.0 - 15.0 * s + 6.0 * s**2)


def forward(stage: Stage, _: MotionOptions) -> Path:
    """Move straight towards the target over the free distance at up to 0.5 m/s, and backwards to the start."""
    half = np.pi * stage.ahead  # [s] one direction; the maximum slope of (1 - cos)/2 is π/2 over it

    def pose(t: float) -> Array:
        return _moved(stage.home, [0, 0, 0.5 * stage.ahead * (1.0 - np.cos(np.pi * t / half))], np.zeros(3))

    return pose


_STEP_M, _STEP_DEG, _STEPS = 0.08, 5.0, 6


def steps(stage: Stage, motion: MotionOptions) -> Path:
    """Step by 8 cm and 5° per frame, up to six steps to both sides, around a point in front of the camera."""
    pivot = stage.home
    lever = 0.5 * _STEP_M / np.sin(np.radians(0.5 * _STEP_DEG))
    level = pivot[:3, 2] * [1, 1, 0]
    center = pivot[:3, 3] + lever * level / np.linalg.norm(level)

    def pose(t: float) -> Array:
        k = _STEPS - abs((t * motion.rate + _STEPS) % (4 * _STEPS) - 2 * _STEPS)  # 0, 1 .. 6, 5 .. -6, -5 ..
        R = so3_exp([0, 0, np.radians(_STEP_DEG * k)])
        T = stage.home
        T[:3, 3] = center + R @ (T[:3, 3] - center)
        T[:3, :3] = R @ T[:3, :3]
        return T

    return pose


def loop(stage: Stage, motion: MotionOptions) -> Path:
    """Move on one circuit during the log; the last pose equals the first."""
    period = motion.duration or 1.0
    return lambda t: _circuit(stage, 2 * np.pi * t / period)


def laps(stage: Stage, _: MotionOptions) -> Path:
    """Repeat the circuit every 20 s."""
    return lambda t: _circuit(stage, 2 * np.pi * t / 20.0)


def _circuit(stage: Stage, angle: float) -> Array:
    if stage.circuit_radius > 0:
        center = np.array(stage.circuit_center)
        out = np.array([np.cos(angle), np.sin(angle), 0.0])
        eye = center + stage.circuit_radius * out
        return look_at(eye, eye + out - [0.0, 0.0, 0.2 + 0.1 * np.sin(angle)])
    target, offset = np.array(stage.target), np.array(stage.eye) - np.array(stage.target)
    distance = float(np.hypot(offset[0], offset[1]))
    azimuth = np.arctan2(offset[1], offset[0]) + 0.7 * np.sin(angle)
    height = offset[2] + 0.3 * distance * (1.0 - np.cos(angle))
    eye = target + np.array([distance * np.cos(azimuth), distance * np.sin(azimuth), height])
    return look_at(eye, target)


TRAJECTORIES: dict[str, Callable[[Stage, MotionOptions], Path]] = {
    path.__name__: path
    for path in (orbit, arm, arm_stops, handheld, rotation, turns, snaps, forward, steps, loop, laps)
}


def _moved(T: Array, move: Array | list[float], turn: Array) -> Array:
    """Return ``T`` after a translation [m] and a rotation vector [rad], both in its own axes."""
    out = T.copy()
    out[:3, 3] += T[:3, :3] @ np.asarray(move)
    out[:3, :3] = T[:3, :3] @ so3_exp(turn)
    return out


def _band(rng: np.random.Generator, low: float, high: float, rms: Array) -> Callable[[float], Array]:
    """Return a random function of time with values (6,) of the given RMS (6,) and frequencies in low..high [Hz].

    It is a sum of 24 sines with random frequencies and phases. Amplitudes are proportional to 1/f, as for a human hand,
    so that every octave adds the same speed.
    """
    frequencies = np.exp(rng.uniform(np.log(low), np.log(high), (24, 6)))
    phases = rng.uniform(0, 2 * np.pi, (24, 6))
    weights = 1.0 / frequencies
    weights *= rms / np.sqrt(0.5 * np.sum(weights**2, axis=0))
    return lambda t: np.sum(weights * np.sin(2 * np.pi * frequencies * t + phases), axis=0)
