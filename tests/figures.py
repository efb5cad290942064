"""Comparison of documented figures with their commands: ``python -m tests.figures`` (``make figures``)."""

from __future__ import annotations

import argparse
import os
import re
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import yaml

ROOT = Path(__file__).parents[1]
FIGURES = ROOT / "docs" / "figures.yaml"
DATA = Path(os.environ.get("SPLATBOT_TEST_DATA") or ROOT.parent / "shared" / "data")


@dataclass(frozen=True)
class Figure:
    """A value in a document.

    Args:
        doc: path of the document.
        text: of the document, with {} in place of the value.
        value: as the document has it.
        pattern: finds the value in the output.
        spread: largest difference that is no change.
    """

    doc: str
    text: str
    value: float | int
    pattern: str
    spread: float

    def stands(self) -> bool:
        """Return whether the document contains the text with the value, in any of its usual spellings."""
        document = " ".join((ROOT / self.doc).read_text().split())
        return any(self.text.replace("{}", f"{self.value:{kind}}") in document for kind in ("", ".1f", ".2f", ".3f"))

    def measured(self, output: str) -> float | None:
        """Return the value that a command printed, or None."""
        found = re.search(self.pattern, output)
        return float(found[1].replace(",", "").rstrip(";")) if found else None


def figures() -> Iterator[tuple[str, list[Figure]]]:
    """Return the commands and their figures."""
    for entry in yaml.safe_load(FIGURES.read_text()):
        yield entry["command"], [Figure(entry["doc"], **figure) for figure in entry["figures"]]


def expanded(command: str, runs: Path, out: Path) -> list[str]:
    """Return the words of a command; maps that are missing are made."""

    def run(name: str) -> str:
        folder = runs / name
        if not (folder / "map.ply").exists():
            print(f"  splatbot map {name} ...", flush=True)
            _call(["splatbot", "map", str(DATA / name), "--out", str(folder), "--quiet"])
        return str(folder)

    text = re.sub(r"\{run (\w+)\}", lambda found: run(found[1]), command)
    text = re.sub(r"\{log (\w+)\}", lambda found: str(DATA / found[1]), text)
    return shlex.split(text.replace("{out}", str(out)))


def _call(words: list[str]) -> str:
    program = Path(sys.executable).with_name(words[0])
    done = subprocess.run([program, *words[1:]], capture_output=True, text=True, env=os.environ | {"COLUMNS": "200"})
    if done.returncode not in (0, 1):
        raise SystemExit(f"{shlex.join(words)} failed:\n{done.stderr[-2000:]}")
    return done.stdout


def main() -> int:
    """Run each command, print each figure, and return 1 if one has changed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--runs", type=Path, default=Path("runs/figures"), help="maps of the recordings, made if missing"
    )
    given = parser.parse_args()
    changed = 0
    for command, wanted in figures():
        print(command, flush=True)
        with tempfile.TemporaryDirectory() as out:
            output = _call(expanded(command, given.runs, Path(out)))
        for figure in wanted:
            now = figure.measured(output)
            same = now is not None and abs(now - figure.value) <= figure.spread + 1e-12
            changed += not same
            shown = "not found" if now is None else f"{now:g}"
            verdict = "as documented" if same else "CHANGED"
            print(f"  {figure.doc}: {figure.value:g} +- {figure.spread:g}, now {shown}: {verdict}", flush=True)
    print(f"{changed} figures have changed" if changed else "all figures are as documented")
    return int(changed > 0)


if __name__ == "__main__":
    sys.exit(main())
