"""The report of a batch: one row for each item of its folder, with the scores that its command wrote."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from splatbot.atomic import replace_files, write_text
from splatbot.batch.item import BatchItem, load_record

_SCORES = {
    "metrics.json": {"ate_rmse_m": "ate_rmse_m", "psnr_db": "psnr_holdout_db", "gaussians": "gaussians"},
    "scores.json": {"psnr_db": "psnr_db", "ssim": "ssim", "gaussians": "gaussians"},
}
"""Columns of the report, each with its key in the file of a command: those of runs and of trainings."""


def batch_rows(items: Sequence[BatchItem], batch: Path) -> list[dict[str, Any]]:
    """Return a row for each item of this call, then for those of earlier calls in the same folder.

    The state is "finished", "failed" or "unfinished". A score that a command did not write is missing.
    """
    names = [item.name for item in items]
    earlier = sorted({record.parent.name for record in batch.glob("*/item.json")} - set(names))
    commands = {item.name: item.words for item in items}
    return [_row(batch / name, commands.get(name, ())) for name in (*names, *earlier)]


def _row(folder: Path, words: Sequence[str]) -> dict[str, Any]:
    record = load_record(folder)
    row = {"name": folder.name, "command": " ".join(record.words if record else words)}
    if record is None:
        return row | {"state": "unfinished"}
    state = {"state": "finished" if record.finished else "failed", "seconds": record.seconds, "error": record.error}
    return row | state | (_scores(folder) if record.finished else {})


def _scores(folder: Path) -> dict[str, Any]:
    """Return the scores in the files of a finished command."""
    found: dict[str, Any] = {}
    for file, keys in _SCORES.items():
        if (folder / file).is_file():
            values = json.loads((folder / file).read_bytes())
            found |= {column: values.get(key) for column, key in keys.items()}
    if (folder / "trials.json").is_file():
        stacks = json.loads((folder / "trials.json").read_bytes())["stacks"]
        found |= {f"success_{stack['stack']}": stack["success"] for stack in stacks}
    return found


def write_report(rows: Sequence[Mapping[str, Any]], batch: Path, *, interrupted: bool) -> None:
    """Write ``batch.json`` and ``batch.csv``."""
    table = io.StringIO()
    writer = csv.DictWriter(table, list(dict.fromkeys(key for row in rows for key in row)), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    values = {"interrupted": interrupted, "items": list(rows)}
    texts = {"batch.json": json.dumps(values, indent=1, allow_nan=False) + "\n", "batch.csv": table.getvalue()}
    replace_files(batch, {name: write_text(text) for name, text in texts.items()})
