"""Changes between two recordings: objects of ray-cast scenes whose truth is known, from other camera paths."""

from __future__ import annotations

import numpy as np
import pytest

from splatbot.collision.changes import ChangedObject, find_changes
from splatbot.logs.raycast import RaycastScene
from tests.changed_scenes import FLOOR, QUAD, SceneLog, ScenePair, matches, reported_places, scene_pair


def _changes(before: RaycastScene, after: RaycastScene, seed: int, frames: int = 60) -> list[ChangedObject]:
    a = SceneLog(before, "orbit", seed=seed, frames=frames).views(4)
    b = SceneLog(after, "arm", seed=seed + 100, start=0.5, frames=frames).views(4)
    return find_changes(*a, *b, floor=FLOOR, quad=QUAD)


def _scores(seeds: range) -> tuple[float, float, int, int]:
    """Return precision and recall of places, and the right and wrong ones of the reported moves."""
    right, reported, true, moves, right_moves = 0, 0, 0, 0, 0
    for seed in seeds:
        pair = scene_pair(seed)
        found = _changes(pair.before, pair.after, seed)
        places = reported_places(found)
        right, reported, true = right + matches(places, pair.places), reported + len(places), true + len(pair.places)
        moved = [change for change in found if change.kind == "moved"]
        moves, right_moves = moves + len(moved), right_moves + sum(_is_true_move(change, pair) for change in moved)
    return right / reported, right / true, right_moves, moves - right_moves


def _is_true_move(change: ChangedObject, pair: ScenePair) -> bool:
    assert change.previous is not None
    was, now = pair.moved
    return bool(np.linalg.norm(change.previous.center - was) < 0.05 and np.linalg.norm(change.center - now) < 0.05)


def test_added_removed_and_moved_objects_are_reported_at_their_places_and_no_others() -> None:
    precision, recall, _, wrong_moves = _scores(range(2))
    assert precision >= 0.95
    assert recall >= 0.95
    assert wrong_moves == 0


@pytest.mark.long
def test_precision_and_recall_of_changed_objects_are_at_least_95_percent_over_24_pairs() -> None:
    precision, recall, right_moves, wrong_moves = _scores(range(24))
    print(f"precision {precision:.3f}, recall {recall:.3f}, moves {right_moves} right, {wrong_moves} wrong, of 24")
    assert precision >= 0.95
    assert recall >= 0.95
    assert right_moves >= 12
    assert wrong_moves <= 2


def test_a_place_without_a_change_has_none() -> None:
    scene = scene_pair(1).before
    assert _changes(scene, scene, 1) == []


def test_space_that_the_other_recording_did_not_see_is_no_change() -> None:
    pair = scene_pair(2)
    views, colors = SceneLog(pair.before, "orbit", seed=2).views(3)
    others, other_colors = SceneLog(pair.after, "arm", seed=3).views(3)
    blind = [(np.zeros_like(depth), camera, T) for depth, camera, T in others]
    assert find_changes(views, colors, blind, other_colors, floor=FLOOR, quad=QUAD) == []
    # an object that hides the whole view leaves the space behind it unknown
    near = [(np.full_like(depth, 0.1), camera, T) for depth, camera, T in others]
    found = find_changes(views, colors, near, other_colors, floor=FLOOR, quad=QUAD)
    assert all(change.kind != "removed" for change in found)


def test_the_box_of_a_change_has_the_size_of_the_object() -> None:
    pair = scene_pair(0)
    found = {change.kind: change for change in _changes(pair.before, pair.after, 0)}
    for change in found.values():
        assert 0.05 < change.size[0] < 0.20  # solids have sides of 5 to 15 cm
        np.testing.assert_allclose(change.axes.T @ change.axes, np.eye(3), atol=1e-9)
