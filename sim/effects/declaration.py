"""Declaration of an effect: its name, its cost, and the observable that it changes."""

from __future__ import annotations

import re
from typing import Any, ClassVar


class DeclaredEffect:
    """Base of effects, each of which states its cost and its observable in the line that begins its class.

    For example: ``class ActuatorLag(PhysicsEffect, cost="one state for each actuator", observable="tracking_rms")``.
    The name follows from that of the class, here ``actuator_lag``; it is also the name of the module.
    """

    name: ClassVar[str]
    cost: ClassVar[str]
    observable: ClassVar[str]

    def __init_subclass__(cls, *, cost: str = "", observable: str = "", **options: Any) -> None:
        super().__init_subclass__(**options)
        cls.name = re.sub(r"(?<!^)(?=[A-Z])", "_", cls.__name__).lower()
        if cost:
            cls.cost = cost
        if observable:
            cls.observable = observable
