"""Plan a certified motion over a cluttered table, time it, and follow it with a simulated controller."""

import numpy as np

from splatbot import GaussianCollisionField, GaussianRRTStar
from splatbot.bench.tabletop import tabletop
from splatbot.planning import certify_motion, time_path
from splatbot.planning.follow import follow
from splatbot.robots.controllers.fake import FakeController
from splatbot.robots.panda import panda

robot = panda()
field = GaussianCollisionField(tabletop().gaussians(20_000))  # a table, a shelf and ten objects
planner = GaussianRRTStar(field, robot, margin=0.005)
goal = np.array([-0.7, 0.5, 0.0, -2.0, 0.0, 2.4, 0.8])  # the straight line to it is blocked

path = planner.plan(robot.home, goal, iterations=300, budget_ms=5000).unwrap()
certificate = path.certificate
print(f"path of {len(path.waypoints)} waypoints, {path.cost:.2f} rad, certified: {certificate.certified}")
print(f"certified clearance: {1e3 * certificate.clearance:.1f} mm beyond a margin of {1e3 * certificate.margin:.0f} mm")

trajectory = time_path(path, planner.arm, field, velocity_scale=0.2, acceleration_scale=0.2)
print(f"trajectory of {trajectory.duration:.2f} s, certified: {trajectory.certificate.certified}")

controller = FakeController(robot.home, lag=0.005)
motion = certify_motion(trajectory, planner.arm, field)  # as it will be executed, in the map of this moment
followed = follow(controller, motion, stop=lambda feedback: feedback.error > 0.05)
print(f"followed: {followed.state}, largest error {1e3 * followed.error.max():.1f} mrad")

failure = planner.plan(robot.home, goal + 3.0, budget_ms=20)
print(f"a goal beyond the joint limits: {failure.status.name}, {failure.cause}")
