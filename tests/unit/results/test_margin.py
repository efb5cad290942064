"""The room to keep from a run's map."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from splatbot.cli import main
from splatbot.collision import GaussianCollisionField
from splatbot.errors import FormatError
from splatbot.gaussians import GaussianModel
from splatbot.results.margin import own_margin
from splatbot.workspace import fit_workspace


def test_the_margin_of_a_run_is_what_its_depth_leaves_outside_of_the_ellipsoids(tmp_path: Path) -> None:
    run = tmp_path / "table"
    assert main(["map", "synthetic:tabletop?frames=2&width=160&height=120", "--out", str(run), "--quiet"]) == 0
    model = GaussianModel.load(run / "map.ply")
    T = fit_workspace(model).T_world_base
    assert T is not None
    thin, thick = (own_margin(run, GaussianCollisionField(model, n), T) for n in (0.2, 3.0))
    assert 0.0 <= thick < thin < 0.3


def test_a_folder_that_holds_no_run_has_none(tmp_path: Path) -> None:
    field = GaussianCollisionField(GaussianModel.empty())
    with pytest.raises(FormatError, match="metrics"):
        own_margin(tmp_path, field, np.eye(4))
