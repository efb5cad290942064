"""`splatbot audit`."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from splatbot.cli import main
from splatbot.formats.ply import save_ply
from splatbot.gaussians import GaussianModel
from splatbot.results.folder import RunFolder
from splatbot.workspace import Workspace
from tests.unit.cli.conftest import RunCommand, assert_refused


@pytest.fixture(scope="module")
def mapped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs") / "table"
    assert main(["map", "synthetic:tabletop?frames=6&width=160&height=120", "--out", str(folder), "--quiet"]) == 0
    return folder


def test_a_run_is_audited_when_it_is_made_and_again_on_request(run: RunCommand, mapped: Path) -> None:
    first = json.loads((mapped / "audit.json").read_text())
    assert "Surfaces seen and missed" in (mapped / "report.html").read_text()
    assert json.loads((mapped / "metrics.json").read_text())["surface_missed_share"] == first["missed_share"]
    answer = run("audit", mapped, "--json")
    assert answer.code == 0, answer.err
    assert json.loads(answer.out) == first == json.loads((mapped / "audit.json").read_text())
    assert first["points_confirmed"] > 1000
    assert first["missed_share"] < 0.01
    assert RunFolder(mapped).check()
    picture = cv2.imread(str(mapped / "audit.png"))
    assert picture is not None
    assert picture.std() > 5


def test_a_part_that_is_cut_out_of_the_map_is_found(run: RunCommand, mapped: Path, tmp_path: Path) -> None:
    folder = tmp_path / "cut"
    folder.mkdir()
    for file in mapped.iterdir():
        if file.is_file() and file.name != "SHA256SUMS":
            (folder / file.name).write_bytes(file.read_bytes())
    model = GaussianModel.load(folder / "map.ply")
    near = (model.means - model.means.median(0).values).norm(dim=1) < 0.12
    save_ply(model.select((~near).nonzero()[:, 0]), folder / "map.ply", bookkeeping=True)
    assert int(near.sum()) > 10
    answer = run("audit", folder)
    assert answer.code == 0, answer.err
    assert "largest holes" in answer.out
    summary = json.loads((folder / "audit.json").read_text())
    assert summary["holes"][0]["length_m"] > 0.05
    center = torch.tensor(summary["holes"][0]["center_m"])
    assert float((center - model.means.median(0).values).norm()) < 0.15


def test_the_audit_numbers_objects_as_the_list_of_objects_does(run: RunCommand, mapped: Path, tmp_path: Path) -> None:
    """The box of the scene leaves objects out, so that a segmentation of the whole map has other numbers."""
    folder = tmp_path / "boxed"
    shutil.copytree(mapped, folder)
    assert run("info", folder, "--fit-plane").code == 0
    every = json.loads(run("objects", folder, "--json").out)["objects"]
    assert len(every) > 1
    last = every[-1]["center_base_m"]
    low, high = [x - 0.15 for x in last], [x + 0.15 for x in last]
    scene = Workspace.load(folder / "scene.yaml")
    replace(scene, box=np.array([low, high])).save(folder / "scene.yaml")
    listed = json.loads(run("objects", folder, "--json").out)["objects"]
    assert 0 < len(listed) < len(every)
    assert run("audit", folder).code == 0
    rows = json.loads((folder / "audit.json").read_text())["by_object"]
    audited = {row["name"] for row in rows if row["name"].startswith("object ")}
    assert audited
    assert audited <= {item["target"] for item in listed}


def test_a_folder_that_is_no_run_is_refused(run: RunCommand, tmp_path: Path) -> None:
    assert_refused(run("audit", tmp_path), "metrics.json")
