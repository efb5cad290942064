"""One search for grasps of a target: candidates are sampled, tested, scored and ranked."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

from splatbot.collision import GaussianCollisionField
from splatbot.gaussians import GaussianModel
from splatbot.grasping.affordance import Target
from splatbot.grasping.antipodal import Pairs, PairSearch, antipodal_pairs
from splatbot.grasping.attached import object_spheres
from splatbot.grasping.doubts import doubt, part_note
from splatbot.grasping.hands import CONSTANTS as HANDS
from splatbot.grasping.hands import Hands, measure_hands, palm_free, place_hands, usable_opening
from splatbot.grasping.lift import lift_target, target_spheres
from splatbot.grasping.measured import CONSTANTS as MEASURED
from splatbot.grasping.measured import RawDepth, blind, closed_width, contact_distances, hand_penetration
from splatbot.grasping.obstacles import Surfaces, around_target, rows_around, rows_without_strays
from splatbot.grasping.options import GraspOptions
from splatbot.grasping.pick_types import PickOptions
from splatbot.grasping.reach import BLOCKED, ReachabilityCheck
from splatbot.grasping.score import ZERO_SCORE_DISTANCE_M, arm_terms, hand_terms, suppress_similar, totals
from splatbot.grasping.sweep import finger_clearance, swept_clearance, touches
from splatbot.grasping.types import FITTING, Grasp, GraspResult
from splatbot.grasping.volume import enclosed_volume
from splatbot.planning.cartesian import along
from splatbot.protocols import Array

if TYPE_CHECKING:
    from splatbot.grasping.sampler import GraspSampler


@dataclass(frozen=True)
class GraspSearchConstants:
    """Constants of the search for grasps.

    Args:
        retry_factor: factor on the number of samples of the second search.
        max_hands_target: maximum number of hands that are checked against the target.
        max_hands_map: maximum number of hands that are checked against the map.
        max_hands_arm: maximum number of hands whose reachability is checked.
        back_off: [m] way back on the approach of a hand that all measured depth, but no sample of it, rejects. It is
            smaller than the step between the depths of hands.
        early_penetration: [m] accepted penetration of fingers into the map before their final opening is known.
        min_top_cosine: minimum cosine between approach direction and down for a top approach.
        min_down_cosine: minimum cosine between approach direction and down for any approach.
        max_side_cosine: maximum cosine between approach direction and vertical for a side approach.
    """

    retry_factor: int = 4
    max_hands_target: int = 2000
    max_hands_map: int = 200
    max_hands_arm: int = 60
    back_off: float = 1e-3
    early_penetration: float = 0.003
    min_top_cosine: float = float(np.cos(np.radians(40.0)))
    min_down_cosine: float = -0.26
    max_side_cosine: float = 0.5


CONSTANTS = GraspSearchConstants()


_IN_TARGET = "hands are in the target on their way"
_IN_MAP = "hands touch the surroundings of the target"
_UNEVEN = "hands have something that stands out under a pad"
_IN_DEPTH = "hands are in measured depth"
_DEEP = "are in measured depth"  # the kind of a rejection by the dense check


@dataclass(eq=False)
class _SearchLog:
    """Number of rejected candidates by reason, the best rejected grasp, and the duration of each stage [s]."""

    rejected: dict[str, int] = field(default_factory=dict)
    best: Grasp | None = None
    seconds: dict[str, float] = field(default_factory=dict)
    began: float = field(default_factory=time.perf_counter)

    def drop(self, reason: str, count: int) -> None:
        self.rejected[reason] = self.rejected.get(reason, 0) + int(count)

    def stage(self, name: str) -> None:
        now = time.perf_counter()
        self.seconds[name], self.began = self.seconds.get(name, 0.0) + now - self.began, now


@dataclass(frozen=True, eq=False)
class _Scored:
    """Hands with their clearances (K,) [m] and score terms (K,)."""

    hands: Hands
    clearance: Array
    terms: Mapping[str, Array]

    def select(self, chosen: NDArray[np.bool_] | NDArray[np.int64]) -> _Scored:
        terms = {name: values[chosen] for name, values in self.terms.items()}
        return _Scored(self.hands.select(chosen), self.clearance[chosen], terms)

    @property
    def totals(self) -> Array:
        return totals(self.terms)


class Search:
    """Pipeline of tests that each reduce the number of hands; :meth:`run` executes it at most twice."""

    def __init__(self, sampler: GraspSampler, target: Target, options: GraspOptions) -> None:
        self.s, self.target, self.o = sampler, target, options
        self.log = _SearchLog()
        self.candidates = 0
        self.measured: Array | None = None

    def run(self) -> GraspResult:
        self.model, self.around, self.own = self._split()
        self.log.stage("fields")
        if self.s.raw is not None:
            self.measured = self.s.raw.around(
                self.s.scene.model.means.detach().double().numpy()[self.target.rows], self.s.hand
            )
            self.log.stage("measured depth")
        self.lift = self._lift() if self.s.departure is not None else None
        grasps, doubtful = self._by_evidence(self._search(self.o.samples))
        notes = []
        too_large = not len(self.pairs.width) and self.found.too_wide > 0
        if not grasps and not too_large:
            few = min(self.o.samples, len(self.surface))
            grasps, more_doubtful = self._by_evidence(self._search(CONSTANTS.retry_factor * self.o.samples, sharp=True))
            doubtful = more_doubtful or doubtful
            more = min(CONSTANTS.retry_factor * self.o.samples, len(self.surface))
            notes.append(f"No grasp was found with {few} samples; {more} samples with sharper edges were searched.")
        return GraspResult(
            self.target,
            grasps,
            self.log.rejected,
            None if grasps else self.log.best,
            self.candidates,
            self.log.seconds,
            self.s.scene.map_version,
            (*notes, *self._notes(grasps)),
            doubtful,
        )

    def _search(self, samples: int, *, sharp: bool = False) -> tuple[Grasp, ...]:
        """Run all stages with a number of seeds."""
        self.surface = self.s.surface(self.target, seed=self.o.seed, sharp=sharp)
        self.body = enclosed_volume(self.surface.points, self.surface.normals, seed=self.o.seed)
        self.log.stage("surface")
        self._contacts(samples)
        self.log.stage("contacts")
        hands = self._placed()
        self.candidates += len(hands)
        scored = self._outside_target(hands)
        self.log.stage("hands")
        scored = self._in_map(scored, self.around)
        if self.s.moving is not None:
            scored = self._with_moving_term(scored)
        self.log.stage("map")
        scored = self._outside_ellipsoids(scored, self.own)
        if self.s.raw is not None:
            scored = self._outside_measured(scored)
            self.log.stage("measured depth")
        around_held, _ = self._around_held(object_spheres(self.surface))
        reach = self.s.reach(self.around, around_held)
        grasps = self._reached(scored, reach, self.s.reach_avoiding_moving(self.model))
        self.log.stage("reach")
        return grasps

    def _around_held(self, spheres: Array) -> tuple[GaussianCollisionField, Surfaces]:
        """Return the field without strays inside of the target, which spheres (A, 4) cover, and its surfaces."""
        rest = rows_without_strays(self.model, spheres)
        surfaces = Surfaces(self.s.scene, rows_around(self.s.scene, self.target.rows)[rest])
        if len(rest) == len(self.model):
            return self.around, surfaces
        return self.s.collision_field(self.model.select(torch.from_numpy(rest))), surfaces

    def _contacts(self, samples: int) -> None:
        self.found: PairSearch = antipodal_pairs(
            self.surface,
            stroke=usable_opening(self.s.hand.stroke),
            friction=self.o.friction,
            samples=samples,
            up=self.s.scene.up,
            seed=self.o.seed,
            near=self.target.point,
        )
        self.pairs: Pairs = self.found.pairs
        self.log.drop("closing directions meet nothing on the other side", self.found.alone)
        self.log.drop("pairs of contacts are farther apart than the hand opens", self.found.too_wide)
        self.log.drop("pairs of contacts are outside of the friction cone", self.found.slipping)

    def _placed(self) -> Hands:
        up, o = self.s.scene.up, self.o
        lowest = CONSTANTS.min_top_cosine if o.approach == "top" else CONSTANTS.min_down_cosine
        hands = place_hands(self.pairs, self.s.hand, rolls=o.rolls, depths=o.depths, up=up, lowest=lowest)
        return (
            hands.select(np.abs(hands.T[:, :3, 2] @ up) < CONSTANTS.max_side_cosine) if o.approach == "side" else hands
        )

    def _promising(self, hands: Hands) -> Hands:
        """Return at most 2000 hands with a free palm, those of the best contact pairs."""
        free = palm_free(hands, self.surface, self.s.hand, retreat=self.o.pregrasp)
        self.log.drop(_IN_TARGET, (~free).sum())
        hands = self._fingers_outside_map(hands.select(free))
        aside = np.linalg.norm(self.pairs.contacts.mean(axis=1) - self.body.center, axis=1)
        good = (self.pairs.closure + self.pairs.observed - aside / 0.1)[hands.pair]
        best = np.sort(np.argsort(-good, kind="stable")[: CONSTANTS.max_hands_target])
        self.log.drop("hands are of worse contacts than others", len(hands) - len(best))
        return hands.select(best)

    def _fingers_outside_map(self, hands: Hands) -> Hands:
        """Return the hands whose fingers are outside of the rest of the map.

        Most hands on a low object fail this quick test. A penetration of 3 mm is left to later tests, since the final
        opening moves the fingers.
        """
        clearance = finger_clearance(self.s.robot, hands, self.around, self.s.hand)
        free = clearance > -CONSTANTS.early_penetration
        self.log.drop(_IN_MAP, (~free).sum())
        if len(free) and not free.any() and self.log.best is None:  # the first search may have a better rejected grasp
            k = int(np.argmax(clearance))
            clearance = clearance - self.s.margin
            self.log.best = self._grasp(self._scored(hands, clearance), k, rejected=_deep(clearance[k]))
        return hands.select(free)

    def _outside_target(self, hands: Hands) -> _Scored:
        """Return the hands without collision with the target, scored without the rest of the map."""
        hands = self._promising(hands)
        if len(hands):
            hands = measure_hands(
                hands,
                self.pairs,
                self.surface,
                self.s.hand,
                retreat=self.o.pregrasp,
                n_sigma=self.s.n_sigma,
                friction=self.o.friction,
            )
        uneven = hands.protrusion > HANDS.max_protrusion
        free = ~uneven & (hands.clearance > 0.0)
        self.log.drop(_UNEVEN, uneven.sum())
        self.log.drop(_IN_TARGET, (~uneven & ~free).sum())
        scored = self._scored(hands, hands.clearance)
        if len(hands) and not free.any():
            worst = np.where(uneven, -hands.protrusion - 1.0, hands.clearance)
            k = int(np.argmax(worst))
            reason = (
                f"has something under a pad that stands out {1e3 * hands.protrusion[k]:.0f} mm"
                if uneven[k]
                else f"is {-1e3 * hands.clearance[k]:.1f} mm deep in the target"
            )
            self.log.best = self._grasp(scored, k, rejected=reason)
        return scored.select(free)

    def _in_map(self, scored: _Scored, around: GaussianCollisionField) -> _Scored:
        """Return the best dissimilar hands that are free of the rest of the map along their approach."""
        best = suppress_similar(scored.hands, scored.totals, most=CONSTANTS.max_hands_map)
        self.log.drop("hands are like a better one", len(scored.hands) - len(best))
        tried = scored.select(best)
        clearance = swept_clearance(self.s.robot, tried.hands, around, retreat=self.o.pregrasp) - self.s.margin
        tried = self._scored(tried.hands, clearance)
        free = clearance > 0.0
        self.log.drop(_IN_MAP, (~free).sum())
        if len(free) and not free.any():
            k = int(np.argmax(clearance))
            self.log.best = self._grasp(tried, k, rejected=_deep(clearance[k]))
        return tried.select(free)

    def _with_moving_term(self, scored: _Scored) -> _Scored:
        """Add the score term for hands that avoid the regions where motion was observed."""
        field = self.s.collision_field(GaussianModel.empty(self.s.scene.model.sh_degree), avoid_moving=True)
        clear = swept_clearance(self.s.robot, scored.hands, field, retreat=self.o.pregrasp) > self.s.margin
        return _Scored(scored.hands, scored.clearance, {**scored.terms, "clear": clear.astype(np.float64)})

    def _outside_ellipsoids(self, scored: _Scored, own: GaussianCollisionField) -> _Scored:
        """Return the best hands, best first, whose boxes do not intersect the target's ellipsoids."""
        order = (
            np.argsort(-scored.totals, kind="stable")[: CONSTANTS.max_hands_arm]
            if len(scored.hands)
            else np.zeros(0, np.int64)
        )
        scored = scored.select(order)
        inside = touches(own, scored.hands, self.s.hand, retreat=self.o.pregrasp)
        self.log.drop("hands touch the target's ellipsoids", inside.sum())
        if inside.any():
            self.log.best = self._grasp(scored, int(inside.argmax()), rejected="touches the target's ellipsoids")
        return scored.select(~inside)

    def _outside_measured(self, scored: _Scored) -> _Scored:
        """Return the hands without confirmed points of raw depth in them, with the score term of their contacts.

        Hands that should not be executed come last. Points that stand out under a pad beyond the planned contacts stop
        the fingers earlier.
        """
        assert self.measured is not None
        assert self.s.raw is not None
        hands = scored.hands
        deep = hand_penetration(hands, self.measured, self.s.hand, retreat=self.o.pregrasp)
        wider = closed_width(hands, self.measured, self.s.hand) - self.pairs.width[hands.pair]
        uneven = wider > 2 * HANDS.max_protrusion
        self.log.drop(_UNEVEN, uneven.sum())
        away = contact_distances(self.pairs.contacts[hands.pair], self.measured)
        supported = (away <= MEASURED.contact_distance).mean(axis=1)
        scored = _Scored(hands, scored.clearance, {**scored.terms, "measured": supported})
        free = (deep <= MEASURED.max_penetration) & ~uneven
        self.log.drop(_IN_DEPTH, (~free & ~uneven).sum())
        if len(free) and not free.any():
            k = int(np.argmin(deep))
            reason = f"is {1e3 * deep[k]:.1f} mm deep in measured depth"
            if deep[k] <= MEASURED.max_penetration:
                reason = f"has measured depth under its pads, so that it closes {1e3 * wider[k]:.0f} mm wider"
            self.log.best = self._grasp(scored, k, rejected=reason)
        kept = scored.select(free)
        hidden = blind(away[free], self.s.raw.unseen(kept.hands, self.s.hand)).any(axis=1)
        tight = self.s.hand.stroke - self.pairs.width[kept.hands.pair] < 2 * MEASURED.implied_gap
        measured = kept.terms["measured"]
        doubtful = hidden | (tight & (measured < 1.0)) | (measured == 0.0)
        return kept.select(np.lexsort((-kept.totals, doubtful)))

    def _reached(
        self, scored: _Scored, reach: ReachabilityCheck | None, avoid_moving: ReachabilityCheck | None
    ) -> tuple[Grasp, ...]:
        """Return the grasps that the arm reaches: those that avoid observed motion first, each group best first.

        Grasps that avoid the regions where motion was observed are also checked first, with these regions as obstacles.
        """
        left = [self._grasp(scored, k) for k in range(len(scored.hands))]
        found: list[Grasp] = []
        if avoid_moving is not None:
            clear = [k for k, grasp in enumerate(left) if grasp.avoids_moving]
            checked = self._checked([left[k] for k in clear], avoid_moving, self.o.wanted)
            found = _best_lifted(checked, self.o.wanted)
            known = {k for k, (grasp, _) in zip(clear, checked, strict=False) if not grasp.rejected}
            left = [_exposed(grasp) for k, grasp in enumerate(left) if k not in known]
        checked = self._checked(left, reach, self.o.wanted - len(found))
        blocked = [(grasp, kind) for grasp, kind in checked if grasp.rejected]
        for _, kind in blocked:
            self.log.drop(FITTING + kind, 1)
        if blocked:  # the best of the most frequent kind, which the advice names
            usual = Counter(kind for _, kind in blocked).most_common(1)[0][0]
            self.log.best = next(grasp for grasp, kind in blocked if kind == usual)
        found += _best_lifted(checked, self.o.wanted - len(found))
        return tuple(sorted(found, key=lambda g: (not g.avoids_moving, bool(g.lift_blocked), -g.total)))

    def _checked(
        self, grasps: Sequence[Grasp], reach: ReachabilityCheck | None, wanted: int
    ) -> list[tuple[Grasp, str]]:
        """Check grasps in order until ``wanted`` can be reached and lifted; return each with its kind of rejection."""
        checked: list[tuple[Grasp, str]] = []
        for grasp in grasps:
            if wanted == 0:
                break
            judged, kind = self._judged(grasp, reach)
            if kind == _DEEP:
                back = self._judged(_backed_off(grasp), reach)
                judged, kind = back if not back[0].rejected else (judged, kind)
            checked.append((judged, kind))
            wanted -= not (judged.rejected or judged.lift_blocked)
        return checked

    def _judged(self, grasp: Grasp, reach: ReachabilityCheck | None) -> tuple[Grasp, str]:
        """Check a grasp with the arm and with all measured depth; return it with the kind of its rejection."""
        judged, kind = (grasp, "") if reach is None else self._with_arm(grasp, reach)
        if not judged.rejected and self.s.raw is not None:
            judged, kind = self._at_full_density(judged, self.s.raw)
        if judged.rejected or judged.q is None or self.lift is None:
            return judged, kind
        return replace(judged, lift_blocked=self.lift(judged.q, judged.width)), kind

    def _lift(self) -> Callable[[Array, float], str]:
        """Return a check of the lift at joint positions (J,) and a width [m], as plans of picks make it; "" is free."""
        o, spheres = PickOptions(), target_spheres(self.s, self.target)
        field, surfaces = self._around_held(spheres)

        def reason(q: Array, width: float) -> str:
            found = lift_target(self.s, spheres, field, surfaces, q, width, lift_off=o.lift_off, height=o.lift)
            return found if isinstance(found, str) else ""

        return reason

    def _with_arm(self, grasp: Grasp, reach: ReachabilityCheck) -> tuple[Grasp, str]:
        reached = reach.reach(grasp.T_world_tcp, grasp.T_world_pregrasp, grasp.opening, grasp.width)
        if reached.q is None or reached.path is None:
            surfaces = Surfaces(self.s.scene, rows_around(self.s.scene, self.target.rows))
            reason = reached.reason if reached.blocked is None else f"{BLOCKED}: {surfaces.reason(reached.blocked)}"
            return replace(grasp, rejected=reason), reached.kind
        found = _with_terms(grasp, arm_terms(reached))
        if reached.T_world_pregrasp is not None:
            found = replace(found, T_world_pregrasp=reached.T_world_pregrasp)
        return replace(found, q=reached.q, q_pregrasp=reached.path[0], approach_path=reached.path), ""

    def _at_full_density(self, grasp: Grasp, raw: RawDepth) -> tuple[Grasp, str]:
        """Check the hand with all confirmed points around it and its approach; no kind of rejection if it is free.

        The width grows to that at which the points stop the fingers, and the closed hand is checked too.
        """
        hands = Hands.one(grasp.T_world_tcp, grasp.opening)
        retreat = grasp.approach_length
        points = raw.along_approach(hands, self.s.hand, retreat)
        width = max(grasp.width, float(closed_width(hands, points, self.s.hand)[0]))
        deep = max(
            float(hand_penetration(hands, points, self.s.hand, retreat=retreat)[0]),
            float(hand_penetration(Hands.one(grasp.T_world_tcp, width), points, self.s.hand, retreat=0.0)[0]),
        )
        if deep > MEASURED.max_penetration:
            return replace(grasp, rejected=f"is {1e3 * deep:.1f} mm deep in measured depth"), _DEEP
        assert grasp.depth_distance is not None
        away = np.minimum(grasp.depth_distance, contact_distances(grasp.contacts, points))
        measured = float((away <= MEASURED.contact_distance).mean())
        known = _with_terms(grasp, {"measured": measured})
        return replace(known, width=width, depth_distance=away, unseen=raw.unseen(hands, self.s.hand)[0]), ""

    def _scored(self, hands: Hands, clearance: Array) -> _Scored:
        terms = hand_terms(
            hands,
            self.pairs,
            self.body,
            self.s.hand,
            clearance,
            friction=self.o.friction,
            up=self.s.scene.up,
            near=self.target.point,
        )
        return _Scored(hands, clearance, terms)

    def _grasp(self, scored: _Scored, k: int, *, rejected: str = "") -> Grasp:
        T, pair = scored.hands.T[k], int(scored.hands.pair[k])
        contacts = self.pairs.contacts[pair]
        return Grasp(
            T_world_tcp=T,
            width=self._closed_width(scored.hands, k),
            opening=float(scored.hands.opening[k]),
            contacts=contacts,
            normals=self.pairs.normals[pair],
            approach=self._approach(T),
            terms={name: float(values[k]) for name, values in scored.terms.items()},
            total=float(scored.totals[k]),
            clearance=float(scored.clearance[k]),
            T_world_pregrasp=along(T, -self.o.pregrasp),
            rejected=rejected,
            depth_distance=None if self.measured is None else contact_distances(contacts, self.measured),
        )

    def _closed_width(self, hands: Hands, k: int) -> float:
        """Return the distance of the pads when they touch: that of the contacts, or wider by measured depth [m]."""
        planned = float(self.pairs.width[hands.pair[k]])
        if self.measured is None:
            return planned
        return max(planned, float(closed_width(hands.select(np.array([k])), self.measured, self.s.hand)[0]))

    def _approach(self, T: Array) -> str:
        z = T[:3, 2]
        if -(z @ self.s.scene.up) >= CONSTANTS.min_top_cosine:
            return "top"
        if abs(z @ self.s.scene.up) >= CONSTANTS.max_side_cosine:
            return "free"
        ahead = T[:3, 3] - self.s.scene.T_world_base[:3, 3]
        ahead = ahead - (ahead @ self.s.scene.up) * self.s.scene.up
        return "front" if z @ ahead >= CONSTANTS.min_top_cosine * np.linalg.norm(ahead) else "side"

    def _split(self) -> tuple[GaussianModel, GaussianCollisionField, GaussianCollisionField]:
        """Return the map without the target, its collision field, and the collision field of the target alone."""
        own = self.s.scene.model.select(torch.from_numpy(self.target.rows))
        around = around_target(self.s.scene, self.target.rows)
        return around, self.s.collision_field(around), self.s.collision_field(own)

    def _by_evidence(self, grasps: Sequence[Grasp]) -> tuple[tuple[Grasp, ...], tuple[Grasp, ...]]:
        """Split grasps into those to offer, and those that are too doubtful, with the reason."""
        judged = [replace(grasp, rejected=doubt(grasp, self.o, self.s.hand)) for grasp in grasps]
        return tuple(g for g in judged if not g.rejected), tuple(g for g in judged if g.rejected)

    def _notes(self, grasps: Sequence[Grasp]) -> tuple[str, ...]:
        notes = []
        if self.s.moving is not None and grasps:
            clear = sum(grasp.avoids_moving for grasp in grasps)
            notes.append(f"Motion was observed; {clear} of {len(grasps)} grasps avoid its region.")
        if grasps and self.target.point is not None:
            away = float(np.linalg.norm(grasps[0].contacts - self.target.point, axis=1).min())
            if away > ZERO_SCORE_DISTANCE_M:
                notes.append(
                    f"The best grasp is {100 * away:.0f} cm from the indicated point. If it is on another object, both "
                    "are connected in the map; a mask separates them."
                )
        unlifted = [grasp for grasp in grasps if grasp.lift_blocked]
        if unlifted:
            notes.append(
                f"{len(unlifted)} of {len(grasps)} grasps have no certified lift, so that plan-pick refuses them: "
                f"{unlifted[0].lift_blocked}. If that neighbour belongs to the target, mark both (--mask)."
            )
        if grasps and (part := part_note(grasps[0], self.surface.points)):
            notes.append(part)
        completed = float(1.0 - self.surface.observed.mean())
        if completed > 0.05:
            notes.append(f"{completed:.0%} of its surface was not observed and is completed.")
        if np.isfinite(self.found.narrowest) and not grasps:
            narrowest, opens, gap = self.found.narrowest, self.s.hand.stroke, HANDS.min_pad_gap
            notes.append(
                f"The narrowest of its sides that are too wide are {1e3 * narrowest:.0f} mm apart, and the hand opens "
                f"{1e3 * opens:.0f} mm, less {1e3 * gap:.0f} mm at each pad."
            )
        return tuple(notes)


def _best_lifted(checked: Sequence[tuple[Grasp, str]], wanted: int) -> list[Grasp]:
    """Return up to ``wanted`` grasps that are not rejected, in order, those with a certified lift first."""
    accepted = [grasp for grasp, _ in checked if not grasp.rejected]
    return sorted(accepted, key=lambda grasp: bool(grasp.lift_blocked))[: max(wanted, 0)]


def _with_terms(grasp: Grasp, terms: Mapping[str, float]) -> Grasp:
    """Return a grasp with further or other score terms, and their total."""
    known = {**grasp.terms, **terms}
    total = float(totals({name: np.array([value]) for name, value in known.items()})[0])
    return replace(grasp, terms=known, total=total)


def _deep(clearance: float) -> str:
    return f"is {-1e3 * clearance:.1f} mm deep in the surroundings of the target"


def _exposed(grasp: Grasp) -> Grasp:
    """Return a grasp with the score term 0 for crossing a region where motion was observed."""
    return replace(grasp, terms={**grasp.terms, "clear": 0.0})


def _backed_off(grasp: Grasp) -> Grasp:
    """Return a grasp 1 mm farther back on its approach, where its hand passes anyway.

    The dense check finds points that the search did not sample, often those under the finger tips.
    """
    T = grasp.T_world_tcp.copy()
    T[:3, 3] -= CONSTANTS.back_off * T[:3, 2]
    return replace(grasp, T_world_tcp=T)
