"""`splatbot eval`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import tyro

from splatbot.cli.paths import check_camera, check_file, check_run
from splatbot.layouts import TRAINING_NAME, log_kind


def eval_run(
    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")],
    /,
    log: Annotated[str | None, tyro.conf.arg(metavar="LOG")] = None,
    camera: Annotated[str | None, tyro.conf.arg(metavar="PRESET|FILE")] = None,
    ground_truth: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False,
) -> int:
    """Score a run or a training again: the trajectory against the reference, the map against held-out views.

    Trajectory errors are after rigid alignment without scale, as `evo_ape tum REFERENCE RUN/trajectory.tum -a` has
    them. Held-out frames were tracked but never mapped; PSNR is over whole images.

    Examples:
        splatbot eval runs/latest
        splatbot eval runs/desk --ground-truth better.tum
        splatbot eval runs/desk --log /mnt/recordings/desk --json
        splatbot eval runs/lego-trained --json

    Args:
        run: a folder that `splatbot map` or `splatbot train` wrote.
        log: where the recording is now, if it was moved.
        camera: intrinsics instead of those that the run used.
        ground_truth: TUM trajectory to compare with instead of the log's own.
        as_json: print JSON instead of a table.
    """
    if (run / TRAINING_NAME).is_file():
        return _eval_training(run, log=log, as_json=as_json)
    check_run(run)
    if log is not None:
        log_kind(log)
    check_camera(camera)
    check_file(ground_truth, "--ground-truth")

    from splatbot.results.folder import RunFolder
    from splatbot.results.rescore import rescore
    from splatbot.robots.in_view import reopen_log
    from splatbot.trajectory import Trajectory

    folder = RunFolder(run)
    recording = reopen_log(folder, uri=log, camera=camera)
    reference = Trajectory.load(ground_truth) if ground_truth else None
    scores = rescore(folder, recording, reference)
    if as_json:
        print(json.dumps(scores, indent=2, allow_nan=False))
    else:
        _print(str(run), scores)
    return 0


def _eval_training(folder: Path, *, log: str | None, as_json: bool) -> int:
    """Score the map of a training on its held-out views, each and on average."""
    from splatbot.cli.datasets import open_training_data
    from splatbot.cli.tables import print_table
    from splatbot.gaussians import GaussianModel
    from splatbot.results.units import decibels, number
    from splatbot.training.folder import TrainingFolder
    from splatbot.training.images import ImageCache
    from splatbot.training.intrinsics import with_refined
    from splatbot.training.scoring import score_held_out, summary

    training = TrainingFolder(folder)
    settings = training.load_settings()
    data = open_training_data(settings.dataset, settings.scale, log)
    _, held_out = data.split(settings.held_out_every)
    held_out = with_refined(held_out, training.load_cameras())
    model = GaussianModel.load(training.map)
    scores = summary(score_held_out(model, ImageCache(held_out), settings.options, data.scene_extent))
    if as_json:
        print(json.dumps(scores, indent=2))
        return 0
    rows = [(view["name"], f"{decibels(view['psnr_db'])}, SSIM {number(view['ssim'], 3)}") for view in scores["views"]]
    rows.append(("mean", f"{decibels(scores['psnr_db'])}, SSIM {number(scores['ssim'], 3)}"))
    rows.append(("colour-corrected", decibels(scores["corrected_psnr_db"])))
    print_table(rows, title=f"{folder}: {scores['held_out']} held-out views")
    return 0


def _print(title: str, scores: dict[str, Any]) -> None:
    from splatbot.cli.tables import print_table
    from splatbot.results.units import count, decibels, metres, millimetres, number, percent

    rows = [
        ("frames tracked", f"{scores['tracked']} of {scores['frames']}"),
        ("ATE RMSE", f"{metres(scores['ate_rmse_m'])}  over {scores['ate_frames']} frames"),
        ("ATE mean, median, max", ", ".join(metres(scores[f"ate_{k}_m"]) for k in ("mean", "median", "max"))),
        ("RPE per frame", f"{metres(scores['rpe_trans_rmse_m'])}, {number(scores['rpe_rot_rmse_deg'], 3)} deg"),
        ("held-out views", str(scores["held_out"])),
        ("PSNR", decibels(scores["psnr_holdout_db"])),
        ("SSIM", number(scores["ssim_holdout"], 3)),
        ("depth error, median", millimetres(scores["depth_median_m"])),
        ("depth error, mean", f"{millimetres(scores['depth_l1_m'])}, with outliers"),
        ("depth covered", percent(scores["depth_coverage"])),
        ("Gaussians", count(scores["gaussians"])),
    ]
    print_table(rows, title=title)
