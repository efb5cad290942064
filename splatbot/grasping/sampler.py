"""Grasps of targets in one state of the map."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from splatbot.collision import GaussianCollisionField
from splatbot.collision.moving import with_balls
from splatbot.collision.visibility import DepthView
from splatbot.errors import InputError
from splatbot.gaussians import GaussianModel
from splatbot.grasping.affordance import Target
from splatbot.grasping.options import GraspOptions
from splatbot.grasping.reach import ArmReach, ReachabilityCheck, hand_of
from splatbot.grasping.search import Search
from splatbot.grasping.shape_completion import target_surface
from splatbot.grasping.surface import GraspSurface
from splatbot.grasping.types import GraspResult
from splatbot.protocols import Array, RobotKinematics
from splatbot.segmentation import SegmentedMap

MakeReach = Callable[[GaussianCollisionField, GaussianCollisionField], ReachabilityCheck]


class GraspSampler:
    """Grasps of targets in one state of the map.

    Args:
        scene: the map and what is in it; its base is the robot's.
        robot: with fingers.
        hand_only: leave the arm out, and look at the hand alone.
        make_reach: gives, for the map without the target and the whole map, who says whether the arm gets there; by
            default :class:`splatbot.grasping.reach.ArmReach`.
        observers: (N, 3) where each Gaussian was seen from [m, world], NaN where that is not known; None: nowhere is.
        views: depth that was measured of the scene, which tells where there is nothing.
        n_sigma: where the surface of a Gaussian is; less than for planning, as the hand has to come near.
        min_observations: Gaussians that fewer keyframes support are air; see
            :class:`splatbot.collision.GaussianCollisionField`.
        margin: room to keep from the map [m].
        moving: balls (V, 4) [m, world] where something was at times; see :func:`splatbot.collision.find_moving`. Grasps
            for which hand and arm need not go there are better.

    Raises:
        InputError: the robot has no fingers, or an argument makes no sense.
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
        n_sigma: float = 1.0,
        min_observations: int = 1,
        margin: float = 0.0,
        moving: Array | None = None,
    ) -> None:
        if observers is not None and observers.shape != (len(scene.model), 3):
            raise InputError(f"is {observers.shape}.", field="observers", hint=f"give ({len(scene.model)}, 3)")
        if not 0.0 <= margin < np.inf:
            raise InputError(f"is {margin}.", field="margin", hint="give metres, 0 or more")
        self.scene, self.robot, self.observers, self.views = scene, robot, observers, tuple(views)
        self.hand = hand_of(robot)
        self.margin, self.n_sigma = margin, n_sigma
        self.moving = None if moving is None or not len(moving) else np.asarray(moving, dtype=np.float64)
        self.min_observations = min_observations
        self.field = self.collision_field(scene.model)
        self._make_reach = None if hand_only else make_reach or self._arm_reach

    def sample(self, target: Target, options: GraspOptions | None = None) -> GraspResult:
        """Ranked grasps of a target; without any, what the candidates fell to.

        Where few hands are possible it is chance whether one is drawn, so where none is found four times the samples
        are looked at, on a surface with sharper rims, and the notes say so; not of what is too large for the hand.

        Raises:
            InputError: the target has no Gaussians.
        """
        if not len(target.rows):
            raise InputError("has no Gaussians.", field=target.label, hint="name another target")
        return Search(self, target, options or GraspOptions()).run()

    def surface(self, target: Target, *, seed: int = 0, sharp: bool = False) -> GraspSurface:
        """Of a target, with unseen sides; see :func:`splatbot.grasping.shape_completion.target_surface`."""
        return target_surface(
            self.scene, target.rows, observers=self.observers, views=self.views, seed=seed, sharp=sharp
        )

    def collision_field(self, model: GaussianModel, *, cautious: bool = False) -> GaussianCollisionField:
        """A part of the map as the hand and the arm avoid it; ``cautious``: and where something moved."""
        if cautious and self.moving is not None:
            model = with_balls(model, self.moving, n_sigma=self.n_sigma, observations=self.min_observations)
        return GaussianCollisionField(model, self.n_sigma, min_observations=self.min_observations)

    def reach(self, around: GaussianCollisionField) -> ReachabilityCheck | None:
        """Who says whether the arm gets there in the map without the target; None: nobody is asked."""
        return None if self._make_reach is None else self._make_reach(around, self.field)

    def cautious_reach(self, around: GaussianModel) -> ReachabilityCheck | None:
        """The same, of an arm that keeps clear of where something moved; None: nothing did, or nobody is asked."""
        if self._make_reach is None or self.moving is None:
            return None
        fields = (self.collision_field(model, cautious=True) for model in (around, self.scene.model))
        return self._make_reach(*fields)

    def _arm_reach(self, around: GaussianCollisionField, whole: GaussianCollisionField) -> ReachabilityCheck:
        return ArmReach(self.robot, self.scene.T_world_base, around, whole, margin=self.margin)
