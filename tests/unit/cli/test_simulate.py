"""`splatbot simulate`: its files equal the log that its URI opens; its effects are in the metrics of the run."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from splatbot.config import Config
from splatbot.formats.trajectory import load_trajectory
from splatbot.logs import open_log
from splatbot.logs.scenes import SCENES
from splatbot.logs.trajectories import TRAJECTORIES
from splatbot.sim.effects.registry import EFFECTS
from tests.unit.cli.conftest import RunCommand, assert_fix_named
from tests.unit.oracle import OracleSlam

SIZE = ("--size", "80x60")
HARD = ("--effect", "exposure:step=2,at=4", "--effect", "depth_noise", "--effect", "blackout:at=6,n=2")


def test_a_recording_holds_the_frames_that_its_address_opens(run: RunCommand, tmp_path: Path) -> None:
    answer = run("simulate", "room", "--trajectory", "handheld", "--frames", 10, *SIZE, *HARD, "--out", tmp_path / "r")
    assert answer.code == 0
    assert "frame 10/10" in answer.err
    uri = json.loads((tmp_path / "r/effects.json").read_text())["uri"]
    assert f'splatbot map "{uri}"' in answer.out
    recorded, direct = open_log(tmp_path / "r"), open_log(uri)
    assert len(recorded) == len(direct) == 10
    assert recorded.camera == direct.camera
    for ours, theirs in zip(recorded, direct, strict=True):
        assert ours.stamp == theirs.stamp
        assert np.array_equal(ours.rgb, theirs.rgb)
        assert np.abs(ours.depth - theirs.depth).max() <= 0.5001 / 5000
    truth, expected = recorded.ground_truth, direct.ground_truth
    assert truth is not None
    assert expected is not None
    np.testing.assert_allclose(truth.T_world_camera, expected.T_world_camera, atol=1e-11)


def test_the_account_says_what_was_on_why_and_what_it_cost(run: RunCommand, tmp_path: Path) -> None:
    assert run("simulate", "tabletop", "--frames", 8, *SIZE, *HARD, "--out", tmp_path / "r", "--quiet").code == 0
    rows = open_log(tmp_path / "r").effects
    assert [row["name"] for row in rows] == ["exposure", "depth_noise", "blackout"]
    assert rows[0]["why"] == "requested as exposure:step=2,at=4"
    assert all(row["frames"] == 8 and row["ms_per_frame"] > 0 for row in rows)


@pytest.mark.parametrize("direct", [False, True])
def test_a_run_names_the_effects_of_its_log(
    run: RunCommand, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, direct: bool
) -> None:
    words = ("simulate", "tabletop", "--frames", 9, *SIZE, "--effect", "depth_noise", "--out", tmp_path / "log")
    assert run(*words, "--quiet").code == 0
    log = json.loads((tmp_path / "log/effects.json").read_text())["uri"] if direct else tmp_path / "log"
    truth = open_log(log).ground_truth
    assert truth is not None

    def slam(config: Config) -> OracleSlam:
        return OracleSlam(truth, config)

    monkeypatch.setattr("splatbot.run.job.Slam", slam)
    assert run("map", log, "--out", tmp_path / "run", "--save-every", 0, "--quiet").code == 0
    (row,) = json.loads((tmp_path / "run/metrics.json").read_text())["effects"]
    assert (row["name"], row["why"]) == ("depth_noise", "requested as depth_noise")
    assert row["frames"] >= 9
    assert row["ms_per_frame"] > 0
    assert "requested as depth_noise" in (tmp_path / "run/report.html").read_text()


def test_without_an_effect_none_is_on(run: RunCommand, tmp_path: Path) -> None:
    assert run("simulate", "wall_blank", "--frames", 2, *SIZE, "--out", tmp_path / "r", "--quiet").code == 0
    assert open_log(tmp_path / "r").effects == []


def test_the_path_of_what_moves_is_written(run: RunCommand, tmp_path: Path) -> None:
    words = ("simulate", "tabletop_crossing", "--event", 0.1, "--frames", 30, *SIZE, "--out", tmp_path / "r")
    assert run(*words, "--quiet").code == 0
    path = load_trajectory(tmp_path / "r/objects/hand.tum")
    assert path.stamps[0] == pytest.approx(0.1)
    assert np.all(np.diff(path.positions[:, 0]) > 0)
    assert "T_world_object" in (tmp_path / "r/objects/hand.tum").read_text()


def test_the_list_names_all_there_is(run: RunCommand) -> None:
    answer = run("simulate", "--list")
    assert answer.code == 0
    for name in (*SCENES, *TRAJECTORIES, *EFFECTS):
        assert f"  {name} " in answer.out


@pytest.mark.parametrize(
    ("words", "named"),
    [
        ([], "SCENE"),
        (["kitchen", "--out", "x"], "tabletop"),
        (["tabletop"], "--out"),
        (["tabletop", "--out", "x", "--size", "640"], "--size"),
        (["tabletop", "--out", "x", "--size", "8x8"], "width"),
        (["tabletop", "--out", "x", "--frames", "0"], "frames"),
        (["tabletop", "--out", "x", "--fps", "0"], "rate"),
        (["tabletop", "--out", "x", "--trajectory", "spiral"], "orbit"),
        (["corridor", "--out", "x", "--trajectory", "orbit"], "forward"),
        (["tabletop", "--out", "x", "--effect", "exposre"], "exposure"),
        (["tabletop", "--out", "x", "--effect", "exposure:stp=2"], "step="),
    ],
)
def test_wrong_words_are_named_and_nothing_is_written(
    run: RunCommand, work_folder: Path, words: list[str], named: str
) -> None:
    assert_fix_named(run("simulate", *words), named)
    assert not list(work_folder.iterdir())


def test_a_recording_is_not_overwritten_nor_given_effects(run: RunCommand, make_log: object, tmp_path: Path) -> None:
    folder = make_log(3)  # type: ignore[operator]
    answer = run("simulate", "tabletop", "--frames", 2, *SIZE, "--effect", "depth_noise", "--out", folder)
    assert answer.code == 2
    assert "already" in answer.err
    assert not (folder / "effects.json").exists()


def test_an_interrupted_recording_still_says_that_it_is_simulated(
    run: RunCommand, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from splatbot.sim.effects.depth_noise import DepthNoise

    real, calls = DepthNoise.apply, []

    def apply(self: DepthNoise, *args: object) -> object:
        calls.append(1)
        if len(calls) == 4:
            raise KeyboardInterrupt
        return real(self, *args)  # type: ignore[arg-type]

    monkeypatch.setattr(DepthNoise, "apply", apply)
    words = ("simulate", "tabletop", "--frames", 9, *SIZE, "--effect", "depth_noise", "--out", tmp_path / "r")
    assert run(*words, "--quiet").code == 130
    log = open_log(tmp_path / "r")
    assert len(log) == 3
    assert log.effects[0]["name"] == "depth_noise"
