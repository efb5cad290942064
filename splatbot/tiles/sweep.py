"""Accuracy of a tiled map against memory and time, compared with the whole map."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.collision import GaussianCollisionField
from splatbot.evaluation.image import psnr
from splatbot.gaussians import GaussianModel
from splatbot.protocols import Array
from splatbot.rasterize.views import render_view
from splatbot.tiles.tiled_map import TiledMap

Image = NDArray[np.float32]


@dataclass(frozen=True)
class TileSweepConstants:
    """Constants of sweeps.

    Args:
        pixel_errors: [px] of the rows.
        supersampling: rays a pixel along each axis of a reference without recording.
        places: boxes that are queried.
        box: [m] their edge.
        spheres: number of spheres in each box.
        radius: [m] largest radius of a sphere.
        seed: of places and spheres.
    """

    pixel_errors: tuple[float, ...] = (0.0, 0.5, 1.0, 2.0, 4.0)
    supersampling: int = 4
    places: int = 8
    box: float = 1.5
    spheres: int = 10_000
    radius: float = 0.1
    seed: int = 0


CONSTANTS = TileSweepConstants()


@dataclass(frozen=True, eq=False)
class SweepView:
    """A view with its reference image (H, W, 3) in 0..1."""

    camera: Camera
    T_world_camera: Array
    reference: Image


@dataclass(frozen=True)
class TiledViewScore:
    """Views of a tiled map at one pixel error.

    Args:
        pixel_error: requested [px].
        reached: largest of all views [px]; larger than requested if the memory does not suffice.
        gaussians: mean number.
        load_ms, render_ms: mean times [ms].
        psnr_db: mean PSNR against the reference.
        least_gain_db: least difference of this PSNR from that of the whole map.
    """

    pixel_error: float
    reached: float
    gaussians: int
    load_ms: float
    render_ms: float
    psnr_db: float
    least_gain_db: float


@dataclass(frozen=True)
class TiledQueryScore:
    """Collision queries in boxes of a tiled map, each by a map that was just opened.

    Args:
        open_ms, field_ms, query_ms: median times to open the map, load the field of a box, and check a sphere [ms].
        gaussians: largest number in a field.
        spheres: number of checked spheres.
        hits: number of those that hit the whole map.
        different: number of those whose verdict differs from that of the whole map.
    """

    open_ms: float
    field_ms: float
    query_ms: float
    gaussians: int
    spheres: int
    hits: int
    different: int


def supersampled(model: GaussianModel, camera: Camera, T_world_camera: Array) -> SweepView:
    """Return a view whose reference is the whole map with several rays a pixel, of 8 bits as recorded images have."""
    k = CONSTANTS.supersampling
    large = render_view(model, camera.resized(k * camera.width, k * camera.height), T_world_camera)
    reference = large.reshape(camera.height, k, camera.width, k, 3).mean(axis=(1, 3))
    return SweepView(camera, T_world_camera, np.rint(255.0 * reference) / np.float32(255.0))


def score_views(model: GaussianModel, tiles: TiledMap, views: Sequence[SweepView]) -> Iterator[TiledViewScore]:
    """Yield the score of each pixel error.

    Args:
        model: the whole map.
        tiles: its tiled map.
        views: one or more.
    """
    whole = [psnr(render_view(model, view.camera, view.T_world_camera), view.reference) for view in views]
    for pixel_error in CONSTANTS.pixel_errors:
        rows = []
        for view, psnr_whole in zip(views, whole, strict=True):
            start = time.perf_counter()
            part = tiles.in_view(view.camera, view.T_world_camera, pixel_error=pixel_error)
            loaded = time.perf_counter()
            image = render_view(part.model, view.camera, view.T_world_camera)
            rendered = time.perf_counter()
            own = psnr(image, view.reference)
            times = 1e3 * (loaded - start), 1e3 * (rendered - loaded)
            rows.append((part.pixel_error, len(part.model), *times, own, own - psnr_whole))
        table = np.array(rows)
        _, gaussians, load_ms, render_ms, own, _ = table.mean(axis=0).tolist()
        reached, least = float(table[:, 0].max()), float(table[:, 5].min())
        yield TiledViewScore(pixel_error, reached, round(gaussians), load_ms, render_ms, own, least)


def score_queries(model: GaussianModel, folder: Path, *, memory_mb: float) -> TiledQueryScore:
    """Compare verdicts in boxes around random Gaussians with those of the whole map.

    Raises:
        InputError: a box needs more memory.
    """
    rng, whole = np.random.default_rng(CONSTANTS.seed), GaussianCollisionField(model)
    means = model.means.double().numpy()
    times, sizes, hits, different = [], [], 0, 0
    half = 0.5 * CONSTANTS.box
    for centre in means[rng.integers(0, len(means), CONSTANTS.places)]:
        inner = half - CONSTANTS.radius
        spheres = np.column_stack(
            [
                centre + rng.uniform(-inner, inner, (CONSTANTS.spheres, 3)),
                rng.uniform(0.0, CONSTANTS.radius, CONSTANTS.spheres),
            ]
        )
        start = time.perf_counter()
        with TiledMap(folder, memory_mb=memory_mb) as tiles:
            opened = time.perf_counter()
            field = tiles.field(centre - half, centre + half)
            loaded = time.perf_counter()
            field.in_collision(spheres[:1])
            times.append((opened - start, loaded - opened, time.perf_counter() - loaded))
            sizes.append(len(field.rows))
            expected = whole.in_collision(spheres)
            hits += int(expected.sum())
            different += int((field.in_collision(spheres) != expected).sum())
    open_ms, field_ms, query_ms = (1e3 * np.median(times, axis=0)).tolist()
    return TiledQueryScore(
        open_ms, field_ms, query_ms, max(sizes), CONSTANTS.places * CONSTANTS.spheres, hits, different
    )
