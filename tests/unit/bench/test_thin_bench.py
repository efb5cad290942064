"""`splatbot bench thin` in its quick form: the probe finds objects that depth cameras measure badly."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatbot.bench.results import Results
from splatbot.bench.thin import BENCHMARK, ThinSettings
from splatbot.bench.thin.scans import BOX, free_probes, make_scan, surface_probes
from splatbot.errors import InputError

KINDS = ("rods", "cable", "wire basket", "glass", "black")


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Results:
    out = tmp_path_factory.mktemp("thin")
    found = BENCHMARK.run(ThinSettings(out=out, quick=True))
    assert json.loads((out / "thin.json").read_text())["rows"]
    return found


def _share(results: Results, case: str) -> float:
    (value,) = [row.value for row in results.rows if row.case == case]
    assert value is not None
    return value


@pytest.mark.parametrize("kind", KINDS)
def test_no_probe_is_missed_where_unknown_space_is_occupied_and_hardly_any_where_it_is_suspect(
    results: Results, kind: str
) -> None:
    assert _share(results, f"{kind}, unknown=occupied") == 0.0
    assert _share(results, f"{kind}, unknown=cautious") <= 1.0


def test_depth_alone_misses_glass_so_that_the_benchmark_can_fail(results: Results) -> None:
    assert _share(results, "glass, unknown=free") > 50.0


def test_most_of_the_space_that_views_saw_through_stays_free(results: Results) -> None:
    assert _share(results, "free space, unknown=free") < 1.0
    assert _share(results, "free space, unknown=cautious") < 40.0


def test_probes_are_in_the_box_and_a_scan_repeats() -> None:
    scan, again = make_scan(3, 3), make_scan(3, 3)
    np.testing.assert_array_equal(scan.views[1][0], again.views[1][0])
    probes = np.concatenate([surface_probes(scan, meshes, 3) for meshes in scan.kinds.values()])
    assert len(probes) > 100
    for some in (probes, free_probes(scan, 3)):
        assert ((some[:, :3] > BOX[0]) & (some[:, :3] < BOX[1])).all()


@pytest.mark.parametrize("values", [{"scans": 0}, {"views": 2}])
def test_settings_that_confirm_nothing_are_refused(values: dict[str, Any], tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--scans, --views"):
        BENCHMARK.run(ThinSettings(out=tmp_path, **values))
