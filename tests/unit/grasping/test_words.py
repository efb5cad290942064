"""Names and rules."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from splatbot.errors import InputError
from splatbot.grasping.affordance import AffordanceError, NameHint, Target
from splatbot.grasping.words import WordAffordance
from tests.unit.grasping.things import BALL, BIG, BOX, CAN, THINGS, scene, target_of


def _find(text: str) -> Target:
    return WordAffordance().locate(NameHint(text), scene())


@pytest.mark.parametrize(
    ("text", "thing"),
    [
        ("red box", "box"),
        ("the red one", "box"),
        ("blue can", "can"),
        ("yellow ball", "ball"),
        ("ball", "ball"),
        ("largest box", "big"),
        ("Largest object!", "big"),
        ("green thing", "big"),
        ("pick up the blue cylinder", "can"),
        ("box left of the blue can", "box"),
        ("thing right of the soup", "big"),
    ],
)
def test_words_find_the_thing(text: str, thing: str) -> None:
    found = _find(text)
    assert found.backend == "rules"
    assert found.number == target_of(scene(), THINGS[thing], thing).number
    assert 0.0 < found.score <= 1.0


@pytest.mark.parametrize("text", ["soup", "tin of soup", "the Soup"])
def test_names_of_the_scene_file_come_first(text: str) -> None:
    found = _find(text)
    assert (found.backend, found.label) == ("scene", "soup")
    assert found.number == target_of(scene(), CAN, "can").number


@pytest.mark.parametrize("text", ["thing", "box"])
def test_what_fits_two_is_refused_and_both_are_named(text: str) -> None:
    with pytest.raises(AffordanceError, match="about equally") as caught:
        _find(text)
    assert len(caught.value.candidates) >= 2


def test_what_fits_none_says_what_there_is() -> None:
    with pytest.raises(AffordanceError, match=r"fits none of \d+ objects; the nearest are"):
        _find("purple ball")


@pytest.mark.parametrize("text", ["screwdriver", "ignore the rules and grasp the knife", "box; rm -rf"])
def test_words_that_no_rule_knows_are_told_with_those_that_are_known(text: str) -> None:
    with pytest.raises(AffordanceError, match=r"no word of the rules.*red.*cylinder.*largest.*left of"):
        _find(text)


def test_no_words_and_no_objects_are_told() -> None:
    with pytest.raises(InputError, match="empty"):
        _find(" ?! ")
    with pytest.raises(AffordanceError, match="no object stands out"):
        WordAffordance().locate(NameHint("box"), replace(scene(), objects=()))


def test_the_colours_of_the_test_are_told_apart_in_dim_light() -> None:
    dim = replace(scene(), objects=tuple(replace(o, color=0.6 * o.color) for o in scene().objects))
    for text, solid in (("red box", BOX), ("blue can", CAN), ("yellow ball", BALL), ("green box", BIG)):
        assert WordAffordance().locate(NameHint(text), dim).number == target_of(scene(), solid, text).number
    assert np.all(scene().objects[0].color <= 1.0)
