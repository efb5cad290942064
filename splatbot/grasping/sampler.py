"""Grasp sampler: ranked grasps of targets in one state of the map."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from splatbot.collision import GaussianCollisionField
from splatbot.collision.moving import with_balls
from splatbot.collision.visibility import DepthView
from splatbot.errors import InputError
from splatbot.gaussians import GaussianModel
from splatbot.grasping.affordance import Target
from splatbot.grasping.measured import RawDepth
from splatbot.grasping.options import GraspOptions
from splatbot.grasping.reach import ArmReach, ReachabilityCheck, with_hand
from splatbot.grasping.search import Search
from splatbot.grasping.shape_completion import target_surface
from splatbot.grasping.surface import GraspSurface
from splatbot.grasping.types import GraspResult
from splatbot.protocols import Array, RobotKinematics
from splatbot.segmentation import SegmentedMap

MakeReach = Callable[[GaussianCollisionField, GaussianCollisionField, GaussianCollisionField], ReachabilityCheck]


class GraspSampler:
    """Samples, scores and ranks grasps of targets in one state of the map.

    Args:
        scene: segmented map; its base frame is that of the robot.
        robot: robot with fingers.
        hand_only: check only the hand, not whether an arm reaches the grasp.
        make_reach: returns the reachability check for the map without the target, the same without strays inside of the
            target, and the whole map. If None,
            :class:`splatbot.grasping.reach.ArmReach` is used.
        observers: (N, 3) camera centre from which each Gaussian was observed [m, world], NaN where unknown. If None,
            all are unknown.
        views: measured depth images of the scene, which show free space.
        raw: raw depth of the scene, against which hands and contacts are checked. If None, only the map is.
        n_sigma: size of the Gaussians in standard deviations. It is smaller than for planning, since the hand has to
            come close to the target.
        min_observations: Gaussians with fewer observing keyframes do not count as obstacles; see
            :class:`splatbot.collision.GaussianCollisionField`.
        margin: clearance that arm and hand keep from the map [m].
        arm_margin: the same for the links before the hand alone [m]. The hand has to come close, and is checked
            against raw depth.
        moving: (V, 4) balls (x, y, z, radius) [m, world] of regions where motion was observed; see
            :func:`splatbot.collision.find_moving`. Grasps that avoid them score higher.

    Raises:
        InputError: the robot has no fingers, or an argument is invalid.
    """

    def __init__(
        self,
        scene: SegmentedMap,
        robot: RobotKinematics,
        *,
        hand_only: bool = False,
        make_reach: MakeReach | None = None,
        observers: Array | None = None,
        views: Sequence[DepthView] = (),
        raw: RawDepth | None = None,
        n_sigma: float = 1.0,
        min_observations: int = 1,
        margin: float = 0.0,
        arm_margin: float = 0.0,
        moving: Array | None = None,
    ) -> None:
        if observers is not None and observers.shape != (len(scene.model), 3):
            raise InputError(f"is {observers.shape}.", field="observers", hint=f"give ({len(scene.model)}, 3)")
        if not 0.0 <= margin < np.inf:
            raise InputError(f"is {margin}.", field="margin", hint="give metres, 0 or more")
        self.robot, self.hand = with_hand(robot)
        self.scene, self.observers, self.views = scene, observers, tuple(views)
        self.raw = raw
        self.margin, self.arm_margin, self.n_sigma = margin, arm_margin, n_sigma
        self.departure: GaussianCollisionField | None = None
        self.departure_avoiding: GaussianCollisionField | None = None
        self.unknown: GaussianCollisionField | None = None
        self.moving = None if moving is None or not len(moving) else np.asarray(moving, dtype=np.float64)
        self.min_observations = min_observations
        self.field = self.collision_field(scene.model)
        self._make_reach = None if hand_only else make_reach or self._arm_reach

    def agree_with_plans(
        self,
        field: GaussianCollisionField,
        unknown: GaussianCollisionField | None = None,
        *,
        avoiding: GaussianCollisionField | None = None,
    ) -> None:
        """Offer only grasps whose pre-grasp a plan may end at.

        Args:
            field: collision field of plans, with all their obstacles.
            unknown: field of unknown space alone, which the links before the hand avoid on the approach. If None, it
                counts as free.
            avoiding: ``field`` with the regions where motion was observed, which pick plans require with ``moving``.
        """
        self.departure, self.unknown, self.departure_avoiding = field, unknown, avoiding

    def sample(self, target: Target, options: GraspOptions | None = None) -> GraspResult:
        """Sample ranked grasps of a target; a result without grasps holds the reasons.

        If no grasp is found, the search is repeated once with four times the samples and sharper edges, and a note
        reports it. A target that is wider than the stroke is not searched again.

        Raises:
            InputError: the target has no Gaussians.
        """
        if not len(target.rows):
            raise InputError("has no Gaussians.", field=target.label, hint="name another target")
        return Search(self, target, options or GraspOptions()).run()

    def surface(self, target: Target, *, seed: int = 0, sharp: bool = False) -> GraspSurface:
        """Return the completed surface of a target; see :func:`splatbot.grasping.shape_completion.target_surface`."""
        return target_surface(
            self.scene, target.rows, observers=self.observers, views=self.views, seed=seed, sharp=sharp
        )

    def collision_field(self, model: GaussianModel, *, avoid_moving: bool = False) -> GaussianCollisionField:
        """Return the collision field of a part of the map.

        If ``avoid_moving`` is set, it includes the regions where motion was observed.
        """
        if avoid_moving and self.moving is not None:
            model = with_balls(model, self.moving, n_sigma=self.n_sigma, observations=self.min_observations)
        return GaussianCollisionField(model, self.n_sigma, min_observations=self.min_observations)

    def reach(self, around: GaussianCollisionField, around_held: GaussianCollisionField) -> ReachabilityCheck | None:
        """Return the reachability check against the map without the target; None if only the hand is checked.

        Args:
            around: field of the map without the target.
            around_held: the same without strays inside of the target, which the closed fingers avoid.
        """
        return None if self._make_reach is None else self._make_reach(around, around_held, self.field)

    def reach_avoiding_moving(self, around: GaussianModel) -> ReachabilityCheck | None:
        """Return the reachability check that also avoids the regions where motion was observed.

        It returns None without such regions, or if only the hand is checked.
        """
        if self._make_reach is None or self.moving is None:
            return None
        without, whole = (self.collision_field(model, avoid_moving=True) for model in (around, self.scene.model))
        return self._make_reach(without, without, whole)

    def _arm_reach(
        self, around: GaussianCollisionField, around_held: GaussianCollisionField, whole: GaussianCollisionField
    ) -> ReachabilityCheck:
        return ArmReach(
            self.robot,
            self.scene.T_world_base,
            around,
            whole,
            around_held=around_held,
            margin=self.margin,
            arm_margin=self.arm_margin,
            departure=self.departure,
            unknown=self.unknown,
        )
