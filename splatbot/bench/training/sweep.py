"""Trainings of one scene that differ in one setting."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np

from splatbot.bench.benchmark import ReportProgress
from splatbot.bench.machine import describe_machine
from splatbot.bench.results import Results
from splatbot.bench.training import Knob, TrainingBenchSettings
from splatbot.errors import InputError
from splatbot.logs import open_log
from splatbot.training.datasets import TrainingData, TrainingView, open_dataset
from splatbot.training.folder import TrainingFolder, TrainingSettings
from splatbot.training.options import USUAL, TrainingOptions
from splatbot.training.session import TrainingSession

VALUES: dict[Knob, Sequence[Any]] = {
    "strategy": ("default", "absgrad", "mcmc", "fixed"),
    "max_gaussians": (10_000, 30_000, 100_000, 300_000),
    "sh_degree": (0, 1, 3),
    "coarse_share": (0.0, 0.15, 0.3, 0.6),
    "scale": (1, 2, 4),
}

_LOG = "synthetic:tabletop?frames=60&width=320&height=240"
_QUICK_LOG = "synthetic:tabletop?frames=12&width=160&height=120"


def run_sweep(settings: TrainingBenchSettings, report_progress: ReportProgress) -> Results:
    """Train with the default settings, then with each other value of each knob.

    Rows of a case: PSNR and SSIM of the held-out views, Gaussians, iterations per second. ``curves`` holds the PSNR
    over the seconds of each case.
    """
    results = Results(describe_machine([1, os.cpu_count() or 1], peak_ms=settings.peak_ms))
    data = _data(settings, settings.scale)
    usual = TrainingOptions(iterations=None, minutes=settings.minutes, seed=settings.seed, **USUAL[data.kind])
    _add(results, "(default)", settings, usual, settings.scale, report_progress)
    for knob in settings.knobs:
        for value in VALUES[knob]:
            scale = value * settings.scale if knob == "scale" else settings.scale
            options = usual if knob == "scale" else replace(usual, **{knob: value})
            if options == usual and scale == settings.scale:
                continue
            _add(results, f"{knob} {value}", settings, options, scale, report_progress)
    return results


def _add(
    results: Results,
    case: str,
    settings: TrainingBenchSettings,
    options: TrainingOptions,
    scale: int,
    report_progress: ReportProgress,
) -> None:
    report_progress(f"training {case}, {settings.minutes:g} min")
    data = _data(settings, scale)
    with TemporaryDirectory() as folder:
        session = TrainingSession(
            data, TrainingFolder(folder), TrainingSettings(data.folder, scale, 8, options), checkpoint_s=1e9
        )
        session.run()
        scores = session.score()
    results.add(case, "PSNR", scores["psnr_db"], "dB")
    results.add(case, "SSIM", scores["ssim"], "")
    results.add(case, "Gaussians", scores["gaussians"], "")
    results.add(case, "iterations/s", scores["iterations"] / scores["seconds"], "1/s")
    course = [(row.seconds, row.psnr_db) for row in session.rows if row.psnr_db is not None]
    results.curves[case] = [*course, (session.seconds, scores["psnr_db"])]
    settings.save(results)


def _data(settings: TrainingBenchSettings, scale: int) -> TrainingData:
    if settings.dataset is not None:
        data = open_dataset(settings.dataset, scale=scale)
        if data.kind == "run":
            hint = "give photographs; `splatbot train RUN` begins with the map of the run"
            raise InputError("is the folder of a run.", file=settings.dataset, field="--dataset", hint=hint)
        return data
    return simulated_data(_QUICK_LOG if settings.quick else _LOG, scale)


def simulated_data(uri: str, scale: int) -> TrainingData:
    """Return the exact images and poses of a simulated log, and points of its depth, as a dataset."""
    log = open_log(uri)
    assert log.ground_truth is not None  # simulated logs have one
    views, points, colors = [], [], []
    for index in range(len(log)):
        frame, T = log.read(index), log.ground_truth.T_world_camera[index]
        size = frame.camera.width // scale, frame.camera.height // scale
        rgb = np.asarray(cv2.resize(frame.rgb, size, interpolation=cv2.INTER_AREA))
        camera = frame.camera.resized(*size)
        views.append(TrainingView(f"{index:04d}", camera, T, partial(np.copy, rgb)))
        step = max(1, frame.depth.shape[1] // 40)
        measured = frame.depth[::step, ::step] > 0
        local = frame.camera.backproject(frame.depth)[::step, ::step][measured].astype(np.float64)
        points.append(local @ T[:3, :3].T + T[:3, 3])
        colors.append(frame.rgb[::step, ::step][measured])
    return TrainingData("nerfstudio", Path(uri), tuple(views), np.concatenate(points), np.concatenate(colors))
