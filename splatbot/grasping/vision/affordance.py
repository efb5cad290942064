"""Target selection by a vision-language model whose answers are checked against the map."""

from __future__ import annotations

import re
import secrets
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from splatbot.errors import InputError
from splatbot.grasping.affordance import Affordance, AffordanceError, NameHint, ObservedView, OneKindAffordance, Target
from splatbot.grasping.spatial import at_point, point_at
from splatbot.grasping.vision.answers import Answer, question_for, read_answers
from splatbot.grasping.vision.models import Picture, VisionError, VisionModel
from splatbot.grasping.vision.views import empty_picture, picture_of, scene_views
from splatbot.protocols import Array
from splatbot.segmentation import SegmentedMap


@dataclass(frozen=True)
class AffordanceConstants:
    """Constants of the choice among the answers of a vision model.

    Args:
        min_confidence: least confidence of an answer that is used.
        single_view_factor: factor on the score of a single view, which no other view confirms.
    """

    min_confidence: float = 0.5
    single_view_factor: float = 0.5


CONSTANTS = AffordanceConstants()


_NAME = re.compile(r"[\w ,.'()/-]{1,80}")  # no quotes and no line breaks, against prompt injection


class VisionAffordance(OneKindAffordance[NameHint]):
    """A :class:`splatbot.grasping.affordance.Affordance` that queries a vision-language model.

    The model locates the object in several images and in one image of the map without objects. Each answer must be a
    pixel of its image that shows a segmented object. The target is the object with more than half of all answers, from
    at least two images. An answer for the image without objects invalidates all answers, and so does a rule-based
    backend that finds another object. The checks cannot detect a model that consistently confuses two objects which the
    rules do not distinguish.

    Args:
        model: the model.
        views: views that the model sees. If None, the map is rendered from cameras around the objects.
        rules: a backend that must not find another object. If None, this is not checked.
        attempts: maximum number of queries until the answer is valid JSON.

    Raises:
        InputError: ``attempts`` is not above 0, or there are no views.
    """

    kind, wanted = NameHint, "a name"

    def __init__(
        self,
        model: VisionModel,
        *,
        views: Sequence[ObservedView] | None = None,
        rules: Affordance | None = None,
        attempts: int = 2,
    ) -> None:
        if attempts < 1 or (views is not None and not views):
            raise InputError("must be above 0, and views be there.", field="attempts, views", hint="give 1 or more")
        self.model, self.rules, self._attempts = model, rules, attempts
        self._views = None if views is None else tuple(views)

    @property
    def name(self) -> str:
        """Name of the backend in results."""
        return self.model.name

    def _find(self, hint: NameHint, scene: SegmentedMap) -> Target:
        """Locate a named object.

        Raises:
            VisionError: the model does not answer, or its answer is invalid.
            AffordanceError: the map does not confirm the answer.
        """
        name = _checked_name(hint.text)
        if not scene.objects:
            raise AffordanceError("there are no objects.", field="target", hint="map a scene with objects")
        views = self._views or scene_views(scene)
        pictures = [picture_of(scene, view) for view in views]
        empty = secrets.randbelow(len(views) + 1)
        pictures.insert(empty, empty_picture(scene, views[0]))
        answers = self._query(name, pictures)
        if any(answer.view == empty for answer in answers):
            raise VisionError(f"sees {name!r} in a picture without objects.", field=self.name, hint="use another model")
        seen = [a.model_copy(update={"view": a.view - (a.view > empty)}) for a in answers]
        return self._judged(name, scene, views, seen)

    def _query(self, name: str, pictures: Sequence[Picture]) -> list[Answer]:
        complaint = ""
        for left in reversed(range(self._attempts)):
            try:
                return read_answers(self.model.ask(question_for(name, pictures, complaint)), pictures)
            except VisionError as error:
                if not (error.again and left):
                    raise
                complaint = error.message
        raise AssertionError("the last attempt returns or raises")

    def _judged(self, name: str, scene: SegmentedMap, views: Sequence[ObservedView], answers: list[Answer]) -> Target:
        if not answers:
            raise AffordanceError(f"sees no {name!r}.", field=self.name, hint="say it in other words, or point at it")
        notes: list[str] = []
        votes: dict[int, list[tuple[Answer, Array]]] = {}
        for answer in answers:
            text = f"picture {answer.view} ({answer.u:g}, {answer.v:g}), {answer.confidence:.2f}: "
            try:
                point = point_at(scene, views[answer.view], answer.u, answer.v)
                number = at_point(scene, point).number
                votes.setdefault(number, []).append((answer, point))
                notes.append(f"{text}object {number}")
            except (AffordanceError, InputError) as error:
                notes.append(f"{text}{error.message}")
        winner = max(votes, key=lambda number: len(votes[number]), default=-1)
        won = votes.get(winner, [])
        if len(won) < min(2, len(views)) or 2 * len(won) <= len(answers):
            raise AffordanceError(
                f"points at no one object: {'; '.join(notes)}.",
                field=self.name,
                hint="say it in other words, or point at it",
                candidates=tuple(_called(scene, number) for number in votes),
            )
        sure = float(np.mean([answer.confidence for answer, _ in won]))
        if sure < CONSTANTS.min_confidence:
            raise AffordanceError(f"is not sure ({sure:.2f}) of {name!r}.", field=self.name, hint="point at it")
        self._agrees(name, scene, winner)
        score = sure * (len(won) / len(views) if len(views) > 1 else CONSTANTS.single_view_factor)
        point = np.mean([at for _, at in won], axis=0)
        return Target(scene.objects[winner].rows, point, _called(scene, winner), self.name, score, tuple(notes), winner)

    def _agrees(self, name: str, scene: SegmentedMap, number: int) -> None:
        """Raise an error if the rules find another object of this name."""
        if self.rules is None:
            return
        try:
            known = self.rules.locate(NameHint(name), scene).number
        except AffordanceError:
            return
        if known not in (-1, number):
            both = (_called(scene, number), _called(scene, known))
            raise AffordanceError(
                f"finds {both[0]} for {name!r}, but {self.rules.name} finds {both[1]}.",
                field=self.name,
                hint="point at it",
                candidates=both,
            )


def _called(scene: SegmentedMap, number: int) -> str:
    return scene.objects[number].name or f"object {number}"


def _checked_name(text: str) -> str:
    """Return the name if it consists of plain words; reject text that a model could read as an instruction."""
    name = " ".join(text.split(" "))
    if not _NAME.fullmatch(name) or not name.strip():
        raise AffordanceError(
            f"is no name: {text[:40]!r}.",
            field="target",
            hint="give up to 80 letters, digits, spaces and , . ' ( ) / -",
        )
    return name.strip()
