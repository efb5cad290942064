"""The examples run in an empty folder, and print the expected results."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[2] / "examples"
MAX_LINES = 40

# A pattern that each output must contain.
EXPECTED = {
    "01_map_a_log.py": r"frame 7: ok.*absolute trajectory error: [0-4]\.\d+ mm over 8 frames.*map\.ply holds \d{4} Gau",
    "02_query_collision.py": r"free\n.*in collision\nclearance .*: 4\d\.\d mm\narm at home: link \d in collision",
    "03_plan_and_follow.py": r"certified: True.*clearance: \d+\.\d mm.*certified: True.*followed: done.*INVALID",
    "04_grasp.py": r"2 objects on 1 support\ntarget: .*can.*rules\n(grasp of width \d\d mm, score 0\.\d\d.*\n){3}",
    "05_render_and_differentiate.py": r"step 0: .* 22\.4 mm\n.*step 100: loss 0\.000\d+, camera error [0-4]\.\d mm",
    "06_query_the_service.py": r"map desk has \d+ Gau.*nearest Gau.* sigma away.*certified: True.*motion: succeeded",
    "07_sensor_effect.py": r"(frame \d: centre x (0\.99|1\.0\d), corner x 0\.[2-4]\d\n){3}.*\['vignette'\]",
    "08_tracking_stage.py": r"frame 1: ok by .*standstill \d\.\d ms\n.*frame 7: ok by \w+\+direct, standstill",
    "09_log_format.py": r"5 frames of recording: ok, ok, ok, ok, ok; \d{4} Gaussians",
}


@pytest.mark.long
@pytest.mark.parametrize("name", sorted(path.name for path in EXAMPLES.glob("*.py")))
def test_an_example_runs_and_prints_its_result(name: str, tmp_path: Path) -> None:
    environment = {key: value for key, value in os.environ.items() if not key.startswith("SPLATBOT_")}
    done = subprocess.run(
        [sys.executable, str(EXAMPLES / name)],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert re.search(EXPECTED[name], done.stdout, flags=re.S), done.stdout


def test_examples_are_short_and_numbered() -> None:
    examples = sorted(EXAMPLES.glob("*.py"))
    assert len(examples) >= 8
    assert all(re.match(r"\d\d_\w+\.py$", path.name) for path in examples)
    assert [path.name for path in examples if len(path.read_text("utf-8").splitlines()) > MAX_LINES] == []
