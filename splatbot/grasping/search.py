"""One search for grasps of a target among Gaussians: sampled, tested, scored and ranked."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

from splatbot.collision import GaussianCollisionField
from splatbot.gaussians import GaussianModel
from splatbot.grasping.affordance import Target
from splatbot.grasping.antipodal import Pairs, PairSearch, antipodal_pairs
from splatbot.grasping.hands import FLUSH, Hands, beside_target, clear_palm, place_hands
from splatbot.grasping.obstacles import around_target
from splatbot.grasping.options import GraspOptions
from splatbot.grasping.reach import ReachabilityCheck
from splatbot.grasping.score import FAR, arm_terms, best_apart, hand_terms, totals
from splatbot.grasping.sweep import fingers_room, swept_room, touches
from splatbot.grasping.types import Grasp, GraspResult
from splatbot.grasping.volume import enclosed_volume
from splatbot.planning.cartesian import along
from splatbot.protocols import Array

if TYPE_CHECKING:
    from splatbot.grasping.sampler import GraspSampler

_MORE = 4  # times the samples for another look
_HANDS = 2000  # whose room beside the target is looked at
_WIDER = 0.003  # [m] that fingers may be in the map before it is known how wide they open
_TRIED = 200  # hands whose room in the map is looked at
_ASKED = 60  # of them that an arm is asked for
_TOP, _LOWEST = np.cos(np.radians(40.0)), -0.26  # cosine between the approach and down: from the top; the least of all
_LEVEL = 0.5  # of a side approach, at most

_IN_TARGET = "hands are in the target on their way"
_IN_MAP = "hands touch what is around the target"


@dataclass(eq=False)
class _SearchLog:
    """What was rejected and why, the best of it, and seconds by stage."""

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
    """Hands with their room [m] and the terms of their scores, each (K,)."""

    hands: Hands
    room: Array
    terms: Mapping[str, Array]

    def select(self, chosen: NDArray[np.bool_] | NDArray[np.int64]) -> _Scored:
        terms = {name: values[chosen] for name, values in self.terms.items()}
        return _Scored(self.hands.select(chosen), self.room[chosen], terms)

    @property
    def totals(self) -> Array:
        return totals(self.terms)


class Search:
    """The steps, each of which leaves fewer hands; :meth:`run` is all of them, at most twice."""

    def __init__(self, sampler: GraspSampler, target: Target, options: GraspOptions) -> None:
        self.s, self.target, self.o = sampler, target, options
        self.log = _SearchLog()
        self.candidates = 0

    def run(self) -> GraspResult:
        self.model, self.around, self.own = self._split()
        self.log.stage("fields")
        grasps, notes = self._look(self.o.samples), []
        too_large = not len(self.pairs.width) and self.found.too_wide > 0
        if not grasps and not too_large:
            few = min(self.o.samples, len(self.surface))
            grasps = self._look(_MORE * self.o.samples, sharp=True)
            more = min(_MORE * self.o.samples, len(self.surface))
            notes.append(f"Nothing was found with {few} samples, so {more} were looked at, with sharper rims.")
        return GraspResult(
            self.target,
            grasps,
            self.log.rejected,
            None if grasps else self.log.best,
            self.candidates,
            self.log.seconds,
            self.s.scene.map_version,
            (*notes, *self._notes(grasps)),
        )

    def _look(self, samples: int, *, sharp: bool = False) -> tuple[Grasp, ...]:
        """What so many samples lead to."""
        self.surface = self.s.surface(self.target, seed=self.o.seed, sharp=sharp)
        self.body = enclosed_volume(self.surface.points, self.surface.normals, seed=self.o.seed)
        self.log.stage("surface")
        self._contacts(samples)
        self.log.stage("contacts")
        hands = self._placed()
        self.candidates += len(hands)
        scored = self._beside_target(hands)
        self.log.stage("hands")
        scored = self._in_map(scored, self.around)
        if self.s.moving is not None:
            scored = self._moving(scored)
        self.log.stage("map")
        scored = self._apart(scored, self.own)
        grasps = self._reached(scored, self.s.reach(self.around), self.s.cautious_reach(self.model))
        self.log.stage("reach")
        return grasps

    def _contacts(self, samples: int) -> None:
        self.found: PairSearch = antipodal_pairs(
            self.surface,
            stroke=self.s.hand.stroke,
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
        lowest = _TOP if o.approach == "top" else _LOWEST
        hands = place_hands(self.pairs, self.s.hand, rolls=o.rolls, depths=o.depths, up=up, lowest=lowest)
        return hands.select(np.abs(hands.T[:, :3, 2] @ up) < _LEVEL) if o.approach == "side" else hands

    def _promising(self, hands: Hands) -> Hands:
        """At most 2000, those whose palm has room, of the best pairs."""
        free = clear_palm(hands, self.surface, self.s.hand, retreat=self.o.pregrasp)
        self.log.drop(_IN_TARGET, (~free).sum())
        hands = self._above(hands.select(free))
        aside = np.linalg.norm(self.pairs.contacts.mean(axis=1) - self.body.center, axis=1)
        good = (self.pairs.closure + self.pairs.seen - aside / 0.1)[hands.pair]
        best = np.sort(np.argsort(-good, kind="stable")[:_HANDS])
        self.log.drop("hands are of worse contacts than others", len(hands) - len(best))
        return hands.select(best)

    def _above(self, hands: Hands) -> Hands:
        """Those whose fingers are not in the rest of the map: of what is low most others are. Few millimetres are left
        to what follows, for fingers that have to open wider are elsewhere."""
        room = fingers_room(self.s.robot, hands, self.around, self.s.hand)
        free = room > -_WIDER
        self.log.drop(_IN_MAP, (~free).sum())
        if len(free) and not free.any() and self.log.best is None:  # in the first look others came farther
            k = int(np.argmax(room))
            room = room - self.s.margin
            self.log.best = self._grasp(self._scored(hands, room), k, rejected=_deep(room[k]))
        return hands.select(free)

    def _beside_target(self, hands: Hands) -> _Scored:
        """Those that the target lets come, with their scores but for the map."""
        hands = self._promising(hands)
        if len(hands):
            hands = beside_target(
                hands,
                self.pairs,
                self.surface,
                self.s.hand,
                retreat=self.o.pregrasp,
                n_sigma=self.s.n_sigma,
                friction=self.o.friction,
            )
        uneven = hands.stands_out > FLUSH
        free = ~uneven & (hands.room > 0.0)
        self.log.drop("hands have something that stands out under a pad", uneven.sum())
        self.log.drop(_IN_TARGET, (~uneven & ~free).sum())
        scored = self._scored(hands, hands.room)
        if len(hands) and not free.any():
            worst = np.where(uneven, -hands.stands_out - 1.0, hands.room)
            k = int(np.argmax(worst))
            why = (
                f"has something under a pad that stands out {1e3 * hands.stands_out[k]:.0f} mm"
                if uneven[k]
                else f"is {-1e3 * hands.room[k]:.1f} mm deep in the target"
            )
            self.log.best = self._grasp(scored, k, rejected=why)
        return scored.select(free)

    def _in_map(self, scored: _Scored, around: GaussianCollisionField) -> _Scored:
        """The best of them, those that are free of the rest of the map on their whole way."""
        best = best_apart(scored.hands, scored.totals, most=_TRIED)
        self.log.drop("hands are like a better one", len(scored.hands) - len(best))
        tried = scored.select(best)
        room = swept_room(self.s.robot, tried.hands, around, retreat=self.o.pregrasp) - self.s.margin
        tried = self._scored(tried.hands, room)
        free = room > 0.0
        self.log.drop(_IN_MAP, (~free).sum())
        if len(free) and not free.any():
            k = int(np.argmax(room))
            self.log.best = self._grasp(tried, k, rejected=_deep(room[k]))
        return tried.select(free)

    def _moving(self, scored: _Scored) -> _Scored:
        """With a term for hands that keep clear, on their way, of where something moved."""
        field = self.s.collision_field(GaussianModel.empty(self.s.scene.model.sh_degree), cautious=True)
        clear = swept_room(self.s.robot, scored.hands, field, retreat=self.o.pregrasp) > self.s.margin
        return _Scored(scored.hands, scored.room, {**scored.terms, "clear": clear.astype(np.float64)})

    def _apart(self, scored: _Scored, own: GaussianCollisionField) -> _Scored:
        """The best of them, best first, those that do not touch the target's own ellipsoids."""
        order = np.argsort(-scored.totals, kind="stable")[:_ASKED] if len(scored.hands) else np.zeros(0, np.int64)
        scored = scored.select(order)
        inside = touches(own, scored.hands, self.s.hand, retreat=self.o.pregrasp)
        self.log.drop("hands touch the target's ellipsoids", inside.sum())
        if inside.any():
            self.log.best = self._grasp(scored, int(inside.argmax()), rejected="touches the target's ellipsoids")
        return scored.select(~inside)

    def _reached(
        self, scored: _Scored, reach: ReachabilityCheck | None, cautious: ReachabilityCheck | None
    ) -> tuple[Grasp, ...]:
        """Those that the arm reaches, best first; cautiously, where it can and the hand can."""
        left = [self._grasp(scored, k) for k in range(len(scored.hands))]
        found: list[Grasp] = []
        if cautious is not None:
            clear = [k for k, grasp in enumerate(left) if grasp.clear]
            asked = self._asked([left[k] for k in clear], cautious, self.o.wanted)
            found = [grasp for grasp, _ in asked if not grasp.rejected]
            known = {k for k, (grasp, _) in zip(clear, asked, strict=False) if not grasp.rejected}
            left = [_exposed(grasp) for k, grasp in enumerate(left) if k not in known]
        asked = self._asked(left, reach, self.o.wanted - len(found))
        blocked = [(grasp, kind) for grasp, kind in asked if grasp.rejected]
        for _, kind in blocked:
            self.log.drop(f"hands: {kind}", 1)
        if blocked:
            self.log.best = blocked[0][0]
        found += [grasp for grasp, _ in asked if not grasp.rejected]
        return tuple(sorted(found, key=lambda g: -g.total))

    def _asked(self, grasps: Sequence[Grasp], reach: ReachabilityCheck | None, wanted: int) -> list[tuple[Grasp, str]]:
        """What an arm says of each in turn, until enough are reached: the grasp, and of what kind its rejection is."""
        asked: list[tuple[Grasp, str]] = []
        for grasp in grasps:
            if wanted == 0:
                break
            asked.append((grasp, "") if reach is None else self._with_arm(grasp, reach))
            wanted -= not asked[-1][0].rejected
        return asked

    def _with_arm(self, grasp: Grasp, reach: ReachabilityCheck) -> tuple[Grasp, str]:
        reached = reach.reach(grasp.T_world_tcp, grasp.T_world_pregrasp, grasp.opening)
        if reached.q is None or reached.path is None:
            return replace(grasp, rejected=reached.why), reached.kind
        terms = dict(grasp.terms) | arm_terms(reached)
        total = float(totals({name: np.array([value]) for name, value in terms.items()})[0])
        q = reached.q
        found = replace(grasp, terms=terms, total=total, q=q, q_pregrasp=reached.path[0], approach_path=reached.path)
        return found, ""

    def _scored(self, hands: Hands, room: Array) -> _Scored:
        terms = hand_terms(
            hands,
            self.pairs,
            self.body,
            self.s.hand,
            room,
            friction=self.o.friction,
            up=self.s.scene.up,
            near=self.target.point,
        )
        return _Scored(hands, room, terms)

    def _grasp(self, scored: _Scored, k: int, *, rejected: str = "") -> Grasp:
        T, pair = scored.hands.T[k], int(scored.hands.pair[k])
        return Grasp(
            T_world_tcp=T,
            width=float(self.pairs.width[pair]),
            opening=float(scored.hands.opening[k]),
            contacts=self.pairs.contacts[pair],
            normals=self.pairs.normals[pair],
            approach=self._approach(T),
            terms={name: float(values[k]) for name, values in scored.terms.items()},
            total=float(scored.totals[k]),
            room=float(scored.room[k]),
            T_world_pregrasp=along(T, -self.o.pregrasp),
            rejected=rejected,
        )

    def _approach(self, T: Array) -> str:
        z = T[:3, 2]
        if -(z @ self.s.scene.up) >= _TOP:
            return "top"
        if abs(z @ self.s.scene.up) >= _LEVEL:
            return "free"
        ahead = T[:3, 3] - self.s.scene.T_world_base[:3, 3]
        ahead = ahead - (ahead @ self.s.scene.up) * self.s.scene.up
        return "front" if z @ ahead >= _TOP * np.linalg.norm(ahead) else "side"

    def _split(self) -> tuple[GaussianModel, GaussianCollisionField, GaussianCollisionField]:
        """The map without the target, also as a field, and the target alone."""
        own = self.s.scene.model.select(torch.from_numpy(self.target.rows))
        around = around_target(self.s.scene, self.target.rows)
        return around, self.s.collision_field(around), self.s.collision_field(own)

    def _notes(self, grasps: Sequence[Grasp]) -> tuple[str, ...]:
        notes = []
        if self.s.moving is not None and grasps:
            clear = sum(grasp.clear for grasp in grasps)
            notes.append(f"Something moved; {clear} of {len(grasps)} grasps keep clear of where it was seen.")
        if grasps and self.target.point is not None:
            away = float(np.linalg.norm(grasps[0].contacts - self.target.point, axis=1).min())
            if away > FAR:
                notes.append(
                    f"The best grasp is {100 * away:.0f} cm from what was pointed at; if that is another thing, both "
                    "hang together in the map, and a mask tells them apart."
                )
        implied = float(1.0 - self.surface.seen.mean())
        if implied > 0.05:
            notes.append(f"{implied:.0%} of its surface was not seen and is implied.")
        if np.isfinite(self.found.narrowest):
            narrowest, opens = 1e3 * self.found.narrowest, 1e3 * self.s.hand.stroke
            notes.append(
                f"The narrowest of its sides that are too wide are {narrowest:.0f} mm apart, and the hand opens "
                f"{opens:.0f} mm."
            )
        return tuple(notes)


def _deep(room: float) -> str:
    return f"is {-1e3 * room:.1f} mm deep in what is around the target"


def _exposed(grasp: Grasp) -> Grasp:
    """A grasp for which the arm has to go where something moved."""
    return replace(grasp, terms={**grasp.terms, "clear": 0.0})
