"""`splatbot train`."""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from splatbot.cli.loading import without_line
from splatbot.cli.messages import set_interruption
from splatbot.cli.paths import check_output, check_training
from splatbot.cli.training_page import served_page, shown_on_page, viewer_port
from splatbot.errors import InputError
from splatbot.layouts import MAP_NAME, dataset_kind, log_kind

if TYPE_CHECKING:
    from splatbot.gaussians import GaussianModel
    from splatbot.results.folder import RunFolder
    from splatbot.training.datasets import TrainingData
    from splatbot.training.distributed import TrainingGroup
    from splatbot.training.folder import TrainingFolder, TrainingSettings
    from splatbot.training.session import TrainingProgress

_DEFAULT_ITERATIONS = 7_000
_WIDE_COLUMNS = 110  # of a terminal that shows all numbers
_MOST_CAMERAS = 4  # of a summary
_OF_A_RUN = "training"  # folder of a training within its run
_PATIENCE_S = 5.0  # of a second Ctrl-C with a step that other processes still compute


def train(
    dataset: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="DATASET")] = None,
    /,
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None,
    minutes: Annotated[float | None, tyro.conf.arg(metavar="MIN")] = None,
    iterations: Annotated[int | None, tyro.conf.arg(metavar="N")] = None,
    strategy: Literal["auto", "default", "absgrad", "mcmc", "fixed"] = "auto",
    max_gaussians: Annotated[int | None, tyro.conf.arg(metavar="N")] = None,
    sh_degree: Annotated[int, tyro.conf.arg(metavar="D")] = 3,
    scale: Annotated[int, tyro.conf.arg(metavar="S")] = 1,
    log: Annotated[str | None, tyro.conf.arg(metavar="LOG")] = None,
    background: Literal["auto", "black", "white", "random"] = "auto",
    refine_poses: bool = False,
    refine_intrinsics: bool = False,
    exposure: bool = False,
    antialiased: bool = False,
    surfels: bool = False,
    batch: Annotated[int | None, tyro.conf.arg(metavar="N")] = None,
    processes: Annotated[int, tyro.conf.arg(metavar="N")] = 1,
    blocks: Annotated[int, tyro.conf.arg(metavar="N")] = 1,
    held_out_every: Annotated[int, tyro.conf.arg(metavar="K")] = 8,
    seed: int = 0,
    checkpoint_every: Annotated[float, tyro.conf.arg(metavar="S")] = 60.0,
    resume: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None,
    overwrite: bool = False,
    viewer: Annotated[tuple[int, ...] | None, tyro.conf.arg(metavar="[PORT]")] = None,
    quiet: bool = False,
) -> int:
    """Train a map of Gaussians from posed photographs, or improve the map of a run.

    DATASET is a COLMAP scene (sparse/0 and images), a Blender scene (transforms_train.json), a Nerfstudio or
    instant-ngp scene (transforms.json), or a folder that `splatbot map` wrote. The map of a run is replaced by the
    trained one; RUN/map.mapped.ply keeps the earlier one.

    Writes map.ply, trajectory.tum, scores.json, progress.jsonl, course.png and held_out.jpg. Held-out views are not
    trained on: every eighth, or those that the dataset marks. Ctrl-C scores and saves the map as it is then. A killed
    run loses at most the time since the last checkpoint. --resume continues both.

    Examples:
        splatbot train scenes/garden --minutes 10 --scale 4
        splatbot train scenes/lego --iterations 20000 --out runs/lego
        splatbot train scenes/fox --strategy mcmc --max-gaussians 100000
        splatbot train scenes/phone --refine-poses --exposure
        splatbot train scenes/statue --surfels
        splatbot train runs/desk --minutes 5
        splatbot train scenes/garden --processes 4
        splatbot train scenes/town --blocks 8 --processes 2
        splatbot train --resume runs/lego
        splatbot render runs/lego --video lego.mp4

    Args:
        dataset: folder of the photographs or of a run.
        out: folder to write; by default runs/NAME-trained. The default for a run is RUN/training; with another folder,
            the run keeps its map.
        minutes: time to train; the schedule follows the clock, so that two runs differ.
        iterations: steps to train; 7,000 unless minutes are given. Such runs repeat bit for bit.
        strategy: Default clones and splits Gaussians, absgrad by absolute gradients. Mcmc moves faint ones and grows to
            the cap. Fixed adds none. Auto selects fixed for a run, mcmc for photographs, default for Blender scenes.
        max_gaussians: largest number of Gaussians: quality for time and memory. By default one for each 100 pixels of
            the training views, at most 200,000; few views do not determine more.
        sh_degree: of view-dependent colour, 0 to 4.
        scale: reduce the photographs to 1/S of their size.
        log: where the recording of a run is now, if it was moved.
        background: behind photographs with alpha; auto is white for Blender scenes and black otherwise.
        refine_poses: correct the camera poses; held-out views are aligned to the map before they are scored.
        refine_intrinsics: correct focal lengths and principal point of each camera, and write cameras.json; lens
            distortion is fixed.
        exposure: compensate the exposure of each photograph by an affine colour transform, and write exposures.json.
            The colour-corrected PSNR does not depend on the exposures of held-out views.
        antialiased: compensate the low-pass filter in opacities, for views from other distances than the photographs'.
        surfels: train flat discs (2D Gaussian splatting), whose surface is more accurate for a mesh
            (docs/guide/surfels.md). The map of a run stays as it is.
        batch: photographs of each step; one for each process by default.
        processes: number of processes that train together; each takes its share of the photographs of a step. For
            several machines use torchrun (docs/guide/distributed.md).
        blocks: number of blocks of the scene that are trained apart and merged. Memory then follows a block, and
            --processes is the number of blocks that train at the same time.
        held_out_every: each K-th view is held out; 0 trains on all.
        seed: of the random draws.
        checkpoint_every: time between two checkpoints [s].
        resume: continue this training; all other options but processes are its own. Give DATASET only if it was
            moved.
        overwrite: replace the training that --out holds.
        viewer: show the training on a page of this machine, at most 5 % of the time; the port is 8081 by default, and 0
            takes a free one. Give it after DATASET.
        quiet: no progress and no summary, only errors.
    """
    if dataset is None and resume is None:
        raise InputError("is missing.", field="DATASET", hint="name a folder of photographs, or --resume a training")
    if not checkpoint_every > 0:
        raise InputError(f"is {checkpoint_every:g}.", field="--checkpoint-every", hint="give seconds above 0")
    if resume is not None:
        check_training(resume, "--resume")
    if dataset is not None:
        dataset_kind(dataset)
    if log is not None:
        log_kind(log)
    check_output(out)
    port = viewer_port(viewer)
    if resume is None:
        set_interruption("interrupted; nothing was trained yet")

    from splatbot.cli.datasets import open_training_data
    from splatbot.training.distributed import planned_group
    from splatbot.training.folder import TrainingFolder, TrainingSettings
    from splatbot.training.options import USUAL, TrainingOptions

    group = planned_group(processes)
    if resume is not None:
        folder = TrainingFolder(resume)
        settings = folder.load_settings()
        if dataset is not None:  # it was moved
            settings = replace(settings, dataset=dataset.resolve())
        data = open_training_data(settings.dataset, settings.scale, log)
    else:
        assert dataset is not None
        data = open_training_data(dataset, scale, log)
        chosen = {"strategy": strategy, "background": background}
        options = TrainingOptions(
            **{**USUAL[data.kind], **{name: value for name, value in chosen.items() if value != "auto"}},
            iterations=_DEFAULT_ITERATIONS if iterations is None and minutes is None else iterations,
            minutes=minutes,
            max_gaussians=max_gaussians,
            sh_degree=sh_degree,
            refine_poses=refine_poses,
            refine_intrinsics=refine_intrinsics,
            exposure=exposure,
            antialiased=antialiased,
            surfels=surfels,
            seed=seed,
            batch=batch if batch is not None else group.size if blocks == 1 else 1,
        )
        default = dataset / _OF_A_RUN if data.kind == "run" else Path("runs") / f"{dataset.resolve().name}-trained"
        folder = TrainingFolder(out or default)
        if group.leads:
            folder.check_free(overwrite=overwrite)
        settings = TrainingSettings(dataset.resolve(), scale, held_out_every, options, blocks)
    if settings.blocks != 1:
        if group.size != processes:
            raise InputError("is for one machine.", field="--blocks", hint="leave torchrun out")
        if port is not None:
            raise InputError("shows one training, not its blocks.", field="--viewer", hint="leave it or --blocks out")
        return _train_blocks(
            data, folder, settings, processes, checkpoint_every, log, resumed=resume is not None, quiet=quiet
        )
    quiet = quiet or not group.leads
    return _train(data, folder, settings, group, checkpoint_every, log, port, resumed=resume is not None, quiet=quiet)


def _train(
    data: TrainingData,
    folder: TrainingFolder,
    settings: TrainingSettings,
    group: TrainingGroup,
    checkpoint_every: float,
    log: str | None,
    port: int | None,
    *,
    resumed: bool,
    quiet: bool,
) -> int:
    from splatbot.report.training import training_pictures
    from splatbot.results.folder import RunFolder
    from splatbot.run.interrupts import Interrupts
    from splatbot.training.distributed import connected
    from splatbot.training.session import TrainingSession

    in_place, begun = _is_in_place(data, folder, settings), resumed
    signals: list[None] = []

    def watch(waited_s: float) -> None:
        if len(signals) > 1 and waited_s > _PATIENCE_S:
            raise KeyboardInterrupt

    with Interrupts() as interrupts, served_page(port if group.leads else None) as page, _progress(quiet) as report:
        interrupts.when_requested = lambda: signals.append(None)
        with _resumable(folder, lambda: begun), ExitStack() as processes:
            with interrupts.interruptible():
                group = processes.enter_context(connected(replace(group, watch=watch), settings, log))
                start = _start(data, folder, settings) if group.leads else None
                session = TrainingSession(
                    data, folder, settings, start=start, checkpoint_s=checkpoint_every, resume=resumed, group=group
                )
                if group.leads and resumed:
                    folder.save_settings(settings)  # the images are those of the start, perhaps at another place
                elif group.leads:
                    folder.begin(settings)
                    begun = True
                set_interruption()
            with shown_on_page(session, page, folder.path.name, quiet=quiet) as observe:
                session.run(report=report, stop=lambda: interrupts.requested is not None, observe=observe)
        if not group.leads:
            return 0
        if in_place:
            RunFolder(data.folder).replace_map(session.trainer.model)
        changes: list[tuple[str, str]] = []
        with interrupts.interruptible(after=int(interrupts.requested is not None)):
            scores = session.score(training_pictures, report)
            if in_place:
                changes = _rescore(RunFolder(data.folder), log)
    if not quiet:
        _print(folder, data.folder / MAP_NAME if in_place else folder.map, scores, changes)
    return 0 if scores["complete"] else _interrupted(folder, interrupts.requested)


@contextmanager
def _resumable(folder: TrainingFolder, begun: Callable[[], bool]) -> Iterator[None]:
    """Name --resume as the fix of a lost process in the block, once this training has a checkpoint."""
    from splatbot.training.helpers import LostProcessError

    try:
        yield
    except LostProcessError as error:
        if error.hint is None and begun() and folder.checkpoint.exists():
            error.hint = f"`splatbot train --resume {folder.path}` continues from the last checkpoint"
        raise


def _train_blocks(
    data: TrainingData,
    folder: TrainingFolder,
    settings: TrainingSettings,
    at_once: int,
    checkpoint_every: float,
    log: str | None,
    *,
    resumed: bool,
    quiet: bool,
) -> int:
    from splatbot.report.training import training_pictures
    from splatbot.results.folder import RunFolder
    from splatbot.run.interrupts import Interrupts
    from splatbot.training.block_training import BlockTraining

    def report(line: str) -> None:
        if not quiet:
            print(line, file=sys.stderr, flush=True)

    in_place = _is_in_place(data, folder, settings)
    with Interrupts() as interrupts:
        with interrupts.interruptible():
            training = BlockTraining(data, folder, settings, start=_start(data, folder, settings), resume=resumed)
            set_interruption()
        if resumed:
            folder.save_settings(settings)
        if not training.run(
            at_once,
            checkpoint_s=checkpoint_every,
            log=log,
            report=report,
            stop=lambda: interrupts.requested is not None,
        ):
            return _interrupted(folder, interrupts.requested)
        model = training.merge()
        if in_place:
            RunFolder(data.folder).replace_map(model)
        changes: list[tuple[str, str]] = []
        with interrupts.interruptible():
            scores = training.score(model, training_pictures, report)
            if in_place:
                changes = _rescore(RunFolder(data.folder), log)
    if not quiet:
        _print(folder, data.folder / MAP_NAME if in_place else folder.map, scores, changes)
    return 0


def _is_in_place(data: TrainingData, folder: TrainingFolder, settings: TrainingSettings) -> bool:
    """Return whether the trained map replaces that of its run."""
    its_own = data.kind == "run" and folder.path.resolve() == (data.folder / _OF_A_RUN).resolve()
    return its_own and settings.options.keeps_frame


def _start(data: TrainingData, folder: TrainingFolder, settings: TrainingSettings) -> GaussianModel | None:
    """Load the Gaussians of the start: those of a block or of a run; None for the points of the dataset."""
    from splatbot.gaussians import GaussianModel
    from splatbot.results.folder import RunFolder

    if settings.block is not None:
        return GaussianModel.load(folder.start)
    return GaussianModel.load(RunFolder(data.folder).map) if data.kind == "run" else None


def _interrupted(folder: TrainingFolder, number: int | None) -> int:
    print(f"interrupted; continue with: splatbot train --resume {folder.path}", file=sys.stderr)
    return 128 + (number or signal.SIGINT)


def _rescore(run: RunFolder, log: str | None) -> list[tuple[str, str]]:
    """Write the figures of the trained map into ``metrics.json`` of its run; return the previous and the new ones.

    ``log`` is where the recording is now.
    """
    from splatbot.results.rescore import rescore
    from splatbot.results.units import decibels, millimetres
    from splatbot.robots.in_view import reopen_log

    before = run.load_metrics()
    after = before | rescore(run, reopen_log(run, uri=log))
    run.save_metrics(after)
    psnr, depth = (
        [shown(values.get(key)) for values in (before, after)]
        for shown, key in ((decibels, "psnr_holdout_db"), (millimetres, "depth_median_m"))
    )
    return [
        ("held-out frames of the run", f"{psnr[0]} before, {psnr[1]} after"),
        ("median depth error on them", f"{depth[0]} before, {depth[1]} after"),
    ]


@contextmanager
def _progress(quiet: bool) -> Iterator[Callable[[TrainingProgress], None]]:
    """Yield a callback that shows a live bar on a terminal, and a plain line every ten seconds elsewhere."""
    if quiet:
        yield lambda progress: None
        return
    if not sys.stderr.isatty():
        yield _PlainTraining()
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn

    columns = (TextColumn("[bold]{task.description}"), BarColumn(bar_width=16), TextColumn("{task.fields[numbers]}"))
    with without_line(), Progress(*columns, console=Console(stderr=True), transient=True) as bars:
        task = bars.add_task("reading", total=1.0, numbers="")
        yield lambda progress: bars.update(
            task,
            description=progress.doing,
            completed=progress.share,
            numbers=_numbers(progress, wide=bars.console.width >= _WIDE_COLUMNS),
        )


class _PlainTraining:
    def __init__(self) -> None:
        self._due = 0.0

    def __call__(self, progress: TrainingProgress) -> None:
        if time.monotonic() >= self._due:
            self._due = time.monotonic() + 10.0
            print(f"{progress.doing} {100 * progress.share:.0f} %  {_numbers(progress)}", file=sys.stderr, flush=True)


def _numbers(progress: TrainingProgress, *, wide: bool = True) -> str:
    row = progress.row
    psnr = f"PSNR {row.psnr_db:.2f} dB" if row.psnr_db is not None else ""
    left = f"{int(progress.remaining_s) // 60}:{int(progress.remaining_s) % 60:02d} left" if progress.share > 0 else ""
    if not wide:
        return "  ".join(filter(None, (f"loss {row.loss:.4f}", psnr, left)))
    parts = (f"iteration {row.iteration:,}", f"loss {row.loss:.4f}", psnr, f"{row.gaussians:,} Gaussians", left)
    return "  ".join(filter(None, parts))


def _print(folder: TrainingFolder, map_: Path, scores: dict[str, Any], changes: list[tuple[str, str]]) -> None:
    from splatbot.cli.tables import print_table
    from splatbot.results.units import count, decibels, number

    pictures = [folder.path / name for name in ("held_out.jpg", "course.png")]
    rows = [
        ("iterations", count(scores["iterations"])),
        ("time of training", f"{scores['seconds'] / 60:.1f} min"),
        ("Gaussians", f"{count(scores['gaussians'])}, SH degree {scores['sh_degree']}"),
        ("held-out views", str(scores["held_out"])),
        ("PSNR", decibels(scores["psnr_db"])),
        ("colour-corrected PSNR", decibels(scores["corrected_psnr_db"])),
        ("SSIM", number(scores["ssim"], 3)),
        *changes,
        *_camera_rows(folder),
        ("map", str(map_)),
        *(("picture", str(path)) for path in pictures if path.exists()),
    ]
    print_table(rows, title=str(folder.path))


def _camera_rows(folder: TrainingFolder) -> list[tuple[str, str]]:
    """Return the first refined cameras with their intrinsics before and after; empty if none were refined."""
    cameras = folder.load_cameras()
    rows = []
    for index, camera in enumerate(cameras[:_MOST_CAMERAS]):
        given, refined = vars(camera.given), vars(camera.refined)
        values = (f"{name} {given[name]:.2f} → {refined[name]:.2f}" for name in ("fx", "fy", "cx", "cy"))
        rows.append((camera.name or f"camera {index + 1}", f"{', '.join(values)} px"))
    if len(cameras) > len(rows):
        rows.append(("more cameras", f"{len(cameras) - len(rows)}, in {folder.cameras}"))
    return rows
