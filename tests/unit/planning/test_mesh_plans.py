"""The check of plans with the maker's meshes finds a contact, and no other."""

from __future__ import annotations

import numpy as np
import pytest

from splatbot.bench.tabletop import Ball, Tabletop
from splatbot.robots.panda import panda

pytest.importorskip("fcl")
pytest.importorskip("collada")


def test_a_ball_in_the_hand_is_a_contact_and_one_next_to_it_is_none() -> None:
    from tests.mesh_plans import MeshedPanda

    meshes, q = MeshedPanda(), panda().home[None]
    flange = panda().fk(panda().home)[-1]
    inside = flange[:3, :3] @ [0.0, 0.0, 0.14] + flange[:3, 3]
    touched = meshes.contacts(q, meshes.world(Tabletop((Ball(tuple(inside), 0.02),))))
    assert "hand" in touched
    away = inside + np.array([0.3, 0.0, 0.0])
    assert meshes.contacts(q, meshes.world(Tabletop((Ball(tuple(away), 0.02),)))) == set()
