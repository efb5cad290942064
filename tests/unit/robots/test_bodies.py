"""Certified bodies against the meshes of the makers, read from the packages that ship them."""

from __future__ import annotations

import importlib.metadata
from pathlib import Path

import numpy as np
import pytest
import trimesh

from splatbot.robots.bodies import Body, load_body, save_body
from splatbot.robots.containment import open_pieces, slack_of, uncovered_by_link
from splatbot.robots.maker_meshes import Source
from splatbot.robots.panda import panda
from splatbot.robots.shapes import Capsule
from splatbot.robots.sources import SOURCES, LinkageSource


@pytest.fixture(scope="module", params=sorted(SOURCES))
def arm(request: pytest.FixtureRequest) -> tuple[Source, Body]:
    """Each shipped arm whose meshes are installed (extra `dev`)."""
    pytest.importorskip("collada")
    source = SOURCES[request.param]
    try:
        importlib.metadata.version(source.package)
    except importlib.metadata.PackageNotFoundError:
        pytest.skip(f"{source.package} is not installed")
    return source, load_body(request.param)


def test_the_body_was_fitted_to_the_meshes_that_are_installed(arm: tuple[Source, Body]) -> None:
    source, body = arm
    assert body.source["sha256"] == source.digest()
    assert set(body.parts) == set(source.parts)


def test_every_triangle_of_visual_and_collision_meshes_is_proven_to_lie_in_the_body(arm: tuple[Source, Body]) -> None:
    source, body = arm
    for part in source.parts:
        bounds = uncovered_by_link(source.shapes(part), body.on(part, 0))
        assert bounds == {0: 0.0}, part


def test_no_point_of_a_million_on_the_meshes_is_outside_by_another_reader(arm: tuple[Source, Body]) -> None:
    # A part is rigid in its link's frame, so that this holds for every posture and every opening of the fingers.
    source, body = arm
    if isinstance(source, LinkageSource):
        pytest.skip("its parts are swept volumes; tests/unit/robots/test_linkage.py has another reader of them")
    files = [(part, file) for part, files in source.parts.items() for file in files]
    for number, (part, file) in enumerate(files):
        mesh = trimesh.load_scene(source.path(file)).to_mesh()
        points, _ = trimesh.sample.sample_surface(mesh, 1_000_000 // len(files) + 1, seed=number)
        spheres = body.parts[part]
        gap = np.min([np.linalg.norm(points - s[:3], axis=1) - s[3] for s in spheres], axis=0)
        assert gap.max() <= 0, part


@pytest.mark.long
def test_the_slack_is_at_most_what_the_documentation_states(arm: tuple[Source, Body]) -> None:
    source, body = arm
    medians, most99 = [], []
    for part, spheres in body.parts.items():
        slack = slack_of(source.shapes(part), spheres[:, :3], spheres[:, 3])
        medians.append(slack.median)
        most99.append(slack.most99)
    assert np.median(medians) <= 0.008
    assert max(medians) <= 0.0085
    assert max(most99) <= 0.015


def test_hand_boxes_contain_the_meshes_of_hand_and_fingers() -> None:
    pytest.importorskip("collada")
    source = SOURCES["panda"]
    hand, tcp = panda().hand, 0.1034
    assert hand is not None
    finger = np.concatenate([s.triangles().reshape(-1, 3) for s in source.shapes("finger")])
    finger = finger + np.array([0.0, 0.0, 0.0584 - tcp])
    assert 2 * np.abs(finger[:, 0]).max() <= hand.width
    assert finger[:, 1].max() <= hand.thickness
    assert finger[:, 2].max() <= hand.tip
    body = np.concatenate([s.triangles().reshape(-1, 3) for s in source.shapes("hand")])
    assert (2 * np.abs(body[:, :2]).max(axis=0) <= hand.palm_size).all()
    assert tcp - body[:, 2].max() >= hand.palm - 2e-5


def test_a_body_with_a_smaller_sphere_is_found_out(arm: tuple[Source, Body]) -> None:
    source, body = arm
    part = "link6" if "link6" in body.parts else "finger"
    spheres = body.parts[part].copy()
    spheres[0, 3] -= 0.01
    triangles = np.concatenate([s.triangles() for s in source.shapes(part)])
    assert len(open_pieces(triangles, spheres[:, :3], spheres[:, 3]))


@pytest.mark.parametrize("opening", [0.0, 0.035, None])
def test_the_twins_capsules_lie_in_the_body(opening: float | None) -> None:
    robot = panda()
    spheres, capsules = robot.spheres(opening), list(robot.shapes)
    assert robot.gripper is not None
    out = np.array([0.0, (0.08 if opening is None else opening) / 2, 0.0])
    for T in robot.gripper.T_link_finger:
        for finger in robot.gripper.shapes:
            assert isinstance(finger, Capsule)
            ends = [tuple(T[:3, :3] @ (np.array(p) + out) + T[:3, 3]) for p in (finger.start, finger.end)]
            capsules.append(Capsule(7, ends[0], ends[1], finger.radius))
    for shape in capsules:
        own = spheres.link == shape.link
        points = shape.surface(0.002)
        gap = np.linalg.norm(points[:, None] - spheres.centers[own], axis=2) - spheres.radii[own]
        assert gap.min(axis=1).max() <= 0


def test_a_body_survives_a_file(tmp_path: Path) -> None:
    body = load_body("panda")
    save_body(body, tmp_path / "body.json")
    assert (tmp_path / "body.json").read_text().count("\n") > 200
    again = (tmp_path / "body.json").read_text()
    save_body(body, tmp_path / "body.json")
    assert (tmp_path / "body.json").read_text() == again
