"""The one change that most likely makes a failed grasp search succeed."""

from __future__ import annotations

from splatbot.grasping.object_list import obstacle
from splatbot.grasping.options import GraspOptions
from splatbot.grasping.reach import BLOCKED, BLOCKED_FAR, BLOCKED_NEAR, TOUCHES
from splatbot.grasping.reach import CONSTANTS as REACH
from splatbot.grasping.types import FITTING, GraspResult
from splatbot.segmentation import SegmentedMap

_USUAL_SAMPLES = GraspOptions().samples
_CHANGES = (
    (
        "farther apart than the hand opens",
        "its faces are farther apart than the hand opens",
        "take a hand that opens wider (`splatbot robot list`), or another target",
    ),
    (
        "meet nothing on the other side",
        "the map shows no opposite faces of it",
        "map it again from more sides",
    ),
    (
        "friction cone",
        "its faces are not parallel enough for this friction",
        "give the friction of your pads (--friction 0.8 for rubber)",
    ),
    (
        "touch the surroundings",
        "the hand touches the objects around it",
        "move its neighbours away, or give a smaller --margin",
    ),
    (
        "in the target on their way",
        "the hand meets the target on its way",
        "try the other direction: --approach top or --approach side",
    ),
    (
        "no posture reaches",
        "the arm does not reach it",
        "correct the base in scene.yaml, or move the target nearer to the arm",
    ),
    (
        "the arm is in the way",
        "the arm collides on its way to it",
        "correct the base in scene.yaml, or check --hand-only",
    ),
    (
        "where no plan may end",
        "its pre-grasps are too near the map or in unknown space",
        "map the place from more sides, let unknown space be free, or start nearer (a smaller --pregrasp)",
    ),
    (
        "into unknown space",
        "the arm would enter unknown space on its way",
        "map the place from more sides, or let unknown space be free",
    ),
    (
        "touch the target before they approach",
        TOUCHES,
        "try the other direction: --approach top or --approach side",
    ),
    (
        BLOCKED_NEAR,
        BLOCKED,
        "move that surface away, or try the other direction: --approach top or --approach side",
    ),
    (BLOCKED_FAR, BLOCKED, f"give a shorter approach: --pregrasp {REACH.short_approach:.2f}"),
)


def first_change(
    result: GraspResult, scene: SegmentedMap, stroke: float, samples: int = _USUAL_SAMPLES
) -> tuple[str, str]:
    """Return the main reason of a search without grasps, and the change to try first.

    Args:
        result: the result without grasps.
        scene: the segmented map.
        stroke: widest opening of the hand [m].
        samples: number of sampled surface points of the search.
    """
    number = result.target.number
    known = scene.objects[number] if 0 <= number < len(scene.objects) else None
    whole = known is not None and len(result.target.rows) >= len(known.rows)  # and no marked part of it
    size = obstacle(known, stroke) if known is not None and whole else None
    if size is None and samples < _USUAL_SAMPLES:
        return f"{samples} sampled points of its surface are few", f"raise --samples, to {_USUAL_SAMPLES} or more"
    if result.doubtful:
        best = result.doubtful[0]
        why = f"{len(result.doubtful)} grasps fit the map, but the best of them {best.rejected}"
        if best.rejected.endswith("the hand opens"):
            return why, "take a hand that opens wider (`splatbot robot list`), or map it again from more sides"
        if best.rejected.startswith("has a confidence"):
            return why, "take another hand, or allow such grasps (--min-confidence)"
        return why, "map it again from more sides, or allow such grasps (--accept-implied)"
    if size is not None:
        return size.reason, "take a hand that opens wider (`splatbot robot list`), or another target"
    # Hands that only the arm rejects fit the object: that reason comes first, however few they are.
    ranked = sorted(result.rejected.items(), key=lambda pair: (not pair[0].startswith(FITTING), -pair[1]))
    for reason, count in ranked:
        for words, why, change in _CHANGES:
            if count and words in reason:
                shown = result.best_rejected
                return shown.rejected if shown is not None and shown.rejected.startswith(why) else why, change
    return "no pair of opposite faces was found", "map it again from more sides, or take another hand"
