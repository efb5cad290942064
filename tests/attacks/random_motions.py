"""Random motions, half of them spoiled, as curves and as ROS goals, against a float64 check of the executed curve.

Run `python -m tests.attacks.random_motions --count 100000`. The check is independent of the gate. It
samples the curve that the controller follows and takes finite differences. The obstacles are balls, so that distances
have a closed form.
"""

from __future__ import annotations

import sys
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.spatial.distance import cdist

from splatbot.collision import RobotSpheres
from splatbot.errors import SplatbotError
from splatbot.gaussians import GaussianModel, Snapshot
from splatbot.geometry import pose_from_quat
from splatbot.logs.ros_types import build
from splatbot.planning import JointTrajectory, WaypointMotion
from splatbot.planning.problem import Certificate
from splatbot.protocols import Array, TimedPath
from splatbot.robots.panda import panda
from splatbot.services.arms import Arms
from splatbot.services.motion_gate import MotionGate, MotionRequest
from splatbot.services.ros.follow import FollowJointTrajectory
from splatbot.services.ros.graph import RosGraph
from splatbot.services.store import MapStore
from splatbot.workspace import Workspace
from tests.attacks.command_line import exit_code, seeded_parser

PERIOD = 1e-3  # [s] of the check
N_SIGMA = 2.0  # of the collision field
_BASE = pose_from_quat((0, 0, 0), (1, 0, 0, 0))
_OTHER_BASE = pose_from_quat((0.3, 0, 0), (1, 0, 0, 0))
_BALLS, _RADIUS = 6, 0.05


@dataclass
class Tally:
    """Counts of a run.

    Args:
        executed, refused: motions by kind.
        wrong: executed motions that the check rejects, with its reason.
        unexplained: refusals without a message.
    """

    executed: Counter[str] = field(default_factory=Counter)
    refused: Counter[str] = field(default_factory=Counter)
    wrong: list[str] = field(default_factory=list)
    unexplained: int = 0


class World:
    """A map of balls and the gate of its arm.

    Args:
        rng: draws the balls.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        self.centers = rng.uniform([-0.7, -0.7, 0.1], [0.7, 0.7, 1.0], (_BALLS, 3))
        self.centers = self.centers[np.linalg.norm(self.centers[:, :2], axis=1) > 0.3]
        self.store = MapStore()
        self.generation = self._serve("desk").generation
        self.gate = MotionGate(self.store)
        self.arms = Arms(self.store)
        self.action = FollowJointTrajectory(RosGraph(), self.arms, self.store)

    def _serve(self, name: str) -> Any:
        n = len(self.centers)
        model = GaussianModel.from_activated(
            means=self.centers,
            quats=np.tile([1.0, 0, 0, 0], (n, 1)),
            scales=np.full((n, 3), _RADIUS / N_SIGMA),
            opacities=np.full(n, 0.9),
            colors=np.full((n, 3), 0.5),
        )
        workspace = Workspace(T_world_base=_BASE)
        return self.store.add(name, source="balls", state="static", snapshot=Snapshot(model, 1), workspace=workspace)

    def from_goal(self, motion: Any, rng: np.random.Generator) -> MotionRequest:
        """Return the motion of a FollowJointTrajectory goal with samples of a motion, as a ROS client sends it."""
        count = int(rng.integers(2, 200))
        times = np.linspace(0.0, motion.duration, count)
        order = rng.permutation(7)
        points = []
        for t in times:
            nanoseconds = round(float(t) * 1e9)
            stamp = {"sec": nanoseconds // 10**9, "nanosec": nanoseconds % 10**9}
            points.append({"positions": motion.reference(float(t))[0][order].tolist(), "time_from_start": stamp})
        names = [panda().chain.names[i] for i in order]
        goal = {"trajectory": {"joint_names": names, "points": points}}
        message = build("control_msgs/msg/FollowJointTrajectoryActionGoal", goal=goal)
        return self.action._request(self.arms.get("fake"), message.goal)

    def rejected(self, motion: TimedPath) -> str:
        """Return why the check rejects the curve as it is executed; empty if it does not."""
        chain = panda().chain
        t = np.arange(0.0, motion.duration + PERIOD, PERIOD)
        q = np.array([motion.reference(float(x))[0] for x in t])
        if not np.isfinite(q).all() or ((q < chain.lower - 2e-6) | (q > chain.upper + 2e-6)).any():
            return "position"
        still = np.concatenate([np.repeat(q[:1], 3, axis=0), q, np.repeat(q[-1:], 3, axis=0)])
        for order, limit in ((1, chain.velocity), (2, chain.acceleration), (3, chain.jerk)):
            # Positions of 1e-16 relative precision give differences of about 1e-15 / PERIOD**order.
            share = np.abs(np.diff(still, n=order, axis=0)) / PERIOD**order / limit
            if share.max() > 1.0 + 1e-5 + 1e-14 / PERIOD**order / limit.min():
                return ("velocity", "acceleration", "jerk")[order - 1]
        arm = RobotSpheres(panda(), T_world_base=_BASE)
        first = arm.spheres.link > 0  # the spheres of the base are not checked against the map
        at = arm.centers(q)[:, first].reshape(-1, 3)
        radii = np.tile(arm.spheres.radii[first], len(q))
        gap = cdist(at, self.centers).min(axis=1) - radii - _RADIUS
        return "collision" if gap.min() < -1e-6 else ""


def _smooth(rng: np.random.Generator) -> tuple[Array, Array]:
    """Return times and waypoints of a motion within the limits."""
    chain = panda().chain
    count = int(rng.integers(2, 7))
    q = panda().home + np.cumsum(rng.normal(0.0, 0.15, (count, 7)), axis=0)
    q = np.clip(q, chain.lower + 0.15, chain.upper - 0.15)
    times = np.linspace(0.0, 1.0, count)
    load = WaypointMotion(times, q).pieces().load(chain)
    shares = (load.velocity, np.sqrt(load.acceleration), np.cbrt(load.jerk))
    return times * max(shares) * rng.uniform(1.001, 2.0), q


def _request(world: World, motion: Any, **more: Any) -> MotionRequest:
    values = {"robot": "panda", "map_id": "desk", "generation": world.generation} | more
    return MotionRequest(motion, **values)


def _fast(world: World, rng: np.random.Generator) -> MotionRequest:
    times, q = _smooth(rng)
    return _request(world, WaypointMotion(times / rng.uniform(2.0, 1e9), q))


def _other_base(world: World, rng: np.random.Generator) -> MotionRequest:
    return _request(world, WaypointMotion(*_smooth(rng)), T_world_base=_OTHER_BASE)


def _other_map(world: World, rng: np.random.Generator) -> MotionRequest:
    more: dict[str, Any] = {"map_id": "gone"} if rng.random() < 0.5 else {"generation": world.generation + 7}
    return _request(world, WaypointMotion(*_smooth(rng)), **more)


def _joint_order(world: World, rng: np.random.Generator) -> MotionRequest:
    times, q = _smooth(rng)
    return _request(world, WaypointMotion(times, q[:, rng.permutation(7)]))


def _stamps(world: World, rng: np.random.Generator) -> MotionRequest:
    times, q = _smooth(rng)
    times[-1] = rng.choice([np.nan, np.inf, times[0], -1.0, 1e300])
    return _request(world, WaypointMotion(times, q))


def _chord(world: World, rng: np.random.Generator) -> MotionRequest:
    """Return a curve that leaves the chords between its waypoints."""
    times, q = _smooth(rng)
    inner = rng.normal(0.0, 0.5, (len(q) + 3, 7)) + q[0]
    control = np.concatenate([np.repeat(inner[:1], 3, axis=0), inner, np.repeat(inner[-1:], 3, axis=0)])
    step = float(times[-1]) / len(inner) * rng.uniform(0.2, 3.0)
    return _request(world, JointTrajectory(panda().chain.names, control, step, Certificate(True, 0.0, 1.0, 0.0, 1)))


SPOILED: dict[str, Callable[[World, np.random.Generator], MotionRequest]] = {
    "velocity": _fast,
    "base": _other_base,
    "map": _other_map,
    "joint order": _joint_order,
    "stamps": _stamps,
    "chord": _chord,
}


def run(count: int, seed: int = 0, *, cpu_s: float = np.inf, show: Callable[[int], None] = lambda done: None) -> Tally:
    """Send ``count`` random motions through the gate, half of them spoiled, and check those that it lets through.

    Args:
        count: motions.
        seed: of the random numbers.
        cpu_s: processor time after which no further motion is sent [s].
        show: called with the number of motions so far.
    """
    rng, tally = np.random.default_rng(seed), Tally()
    world = World(rng)
    for k in range(count):
        if k % 100 == 0:
            if time.process_time() > cpu_s:
                break
            world.arms.close(0.0)
            world = World(rng)
            show(k)
        kind = "valid" if k % 2 == 0 else str(rng.choice(list(SPOILED)))
        try:
            made = _request(world, WaypointMotion(*_smooth(rng))) if kind == "valid" else SPOILED[kind](world, rng)
            if k % 3 == 0 and kind not in ("base", "map"):
                made = world.from_goal(made.motion, rng)
            motion = world.gate.certify(made, panda())
        except SplatbotError as error:
            tally.refused[kind] += 1
            tally.unexplained += not error.message
            continue
        tally.executed[kind] += 1
        if why := world.rejected(motion):
            tally.wrong.append(f"motion {k} ({kind}): {why}")
        if kind in ("base", "map", "stamps"):
            tally.wrong.append(f"motion {k}: was made for another {kind}")
    return tally


def main() -> int:
    """Run and print the counts."""
    parser = seeded_parser(__doc__, 100_000)
    parser.add_argument("--cpu-minutes", type=float, default=np.inf, help="processor time after which the run ends")
    given = parser.parse_args()

    def show(done: int) -> None:
        print(f"\r{done}", end="", file=sys.stderr, flush=True)

    tally = run(given.count, given.seed, cpu_s=60 * given.cpu_minutes, show=show)
    sent = sum(tally.executed.values()) + sum(tally.refused.values())
    print(f"\n{sent} motions, {time.process_time() / 60:.1f} min of one core")
    print(f"executed {dict(tally.executed)}\nrefused {dict(tally.refused)}")
    print(f"executed and rejected by the check: {len(tally.wrong)}; refused without a reason: {tally.unexplained}")
    return exit_code(tally.wrong) or int(tally.unexplained > 0)


if __name__ == "__main__":
    sys.exit(main())
