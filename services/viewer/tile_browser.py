"""One browser that shows a tiled map: its camera, its tiles and its controls."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import viser

from splatbot.camera import Camera
from splatbot.errors import InputError, SplatbotError
from splatbot.gaussians import GaussianModel
from splatbot.geometry import pose_from_quat
from splatbot.protocols import Array
from splatbot.services.viewer.measuring import surface_point
from splatbot.services.viewer.scene import show_distance
from splatbot.services.viewer.splats import COLORINGS, Coloring, Splats, splats
from splatbot.services.viewer.viewer import CONSTANTS as VIEWER
from splatbot.tiles import TileCover, TiledMap


@dataclass(frozen=True)
class TileBrowserConstants:
    """Constants of a browser of a tiled map.

    Args:
        rest: [s] time without a change after which the tiles follow the camera.
        period: [s] least time between two updates of a browser.
        margin: width of the view for which tiles are chosen, in widths of the page; small turns stay inside it.
    """

    rest: float = 0.25
    period: float = 0.5
    margin: float = 1.15


CONSTANTS = TileBrowserConstants()
TILE_COLORINGS = tuple(name for name in COLORINGS if name != "uncertainty")

_NOT_SHOWN = (
    "This map is tiled: the browser has the tiles of its view only. Planned motions, grasps and uncertainty are not "
    "shown: the first two need the whole map, and merged Gaussians have no uncertainty."
)
_Key = tuple[int, Coloring, float]  # of a drawn tile: its number, colouring, and crop [m]


@dataclass(frozen=True, eq=False)
class BrowserCamera:
    """The camera of a page.

    Args:
        wxyz, position: T_world_camera [m]; axes as in OpenCV.
        fov: vertical field of view [rad].
        width, height: of the page [px].
    """

    wxyz: Array
    position: Array
    fov: float
    width: int
    height: int

    @staticmethod
    def of(handle: viser.CameraHandle) -> BrowserCamera:
        """Return the values of viser's camera."""
        return BrowserCamera(handle.wxyz, handle.position, handle.fov, handle.image_width, handle.image_height)

    def pinhole(self, margin: float = 1.0) -> tuple[Camera, Array]:
        """Return the camera of an image ``margin`` times as wide and high, and T_world_camera (4, 4).

        Raises:
            InputError: the values are those of no camera.
        """
        if self.wxyz.shape != (4,) or self.position.shape != (3,) or not np.isfinite(self.position).all():
            raise InputError("is no finite pose.", field="camera of the browser", hint="reset its view")
        try:
            pose = pose_from_quat(self.position, self.wxyz)
        except ValueError as error:
            raise InputError(f"is no pose: {error}.", field="camera of the browser", hint="reset its view") from error
        focal = 0.5 * self.height / np.tan(0.5 * self.fov)
        width, height = round(margin * self.width), round(margin * self.height)
        return Camera(focal, focal, (width - 1) / 2, (height - 1) / 2, width, height), pose


class TileBrowser:
    """Shows the tiles of its camera in one browser; one thread calls :meth:`update`, viser's threads report changes.

    It receives the coarsest tile first. When the camera has rested, the tiles of its view replace those that it has.
    Tiles in both covers stay. Tiles leave before others are sent, under names that are used once. So the browser never
    has more Gaussians than the memory of the tiles, and a slow one has as many at most on their way.

    Args:
        client: viser's.
        tiles: the map.
        wake: reports that :attr:`due_s` may have changed.
        pixel_error: largest edge of a cell of merged Gaussians [px].
        middle: (3,) of the crop [m].
        overview: the coarsest tile, which gives the ends of colour scales.
        note: more text for the page.
    """

    def __init__(
        self,
        client: viser.ClientHandle,
        tiles: TiledMap,
        wake: Callable[[], None],
        *,
        pixel_error: float,
        middle: Array,
        overview: GaussianModel,
        note: str = "",
    ) -> None:
        self._client, self._tiles, self._wake = client, tiles, wake
        self._pixel_error, self._overview, self._note = pixel_error, overview, note
        self._middle = torch.from_numpy(np.asarray(middle, np.float32))
        self._camera = BrowserCamera.of(client.camera)
        self._drawn: dict[_Key, viser.GaussianSplatHandle] = {}
        self._serials = itertools.count()
        self._clicked: list[Array] = []
        self._ray: tuple[Array, Array] | None = None
        self._is_new, self.has_left = True, False
        self._changed_s, self._served_s = time.monotonic(), -np.inf
        self._add_controls()

    @property
    def due_s(self) -> float:
        """Time of the next update on the monotonic clock [s]; infinite without a change, past after :meth:`leave`."""
        if self.has_left:
            return -np.inf
        if self._is_new or self._ray is not None:
            return self._served_s + CONSTANTS.period
        return max(self._changed_s + CONSTANTS.rest, self._served_s + CONSTANTS.period)

    def update(self) -> None:
        """Send the changes that are due, or the reason why they cannot be shown."""
        self._served_s = time.monotonic()
        try:
            if self._is_new:
                self._is_new = False
                self._show(self._tiles.coarsest())
                return
            if self._ray is not None:
                ray, self._ray = self._ray, None
                self._take_click(*ray)
            if self._changed_s + CONSTANTS.rest <= self._served_s:
                self._changed_s = np.inf
                camera, pose = self._camera.pinhole(CONSTANTS.margin)
                self._show(self._tiles.cover(camera, pose, pixel_error=self._pixel_error))
        except SplatbotError as error:
            self._state.content = f"**cannot be shown:** {error}"

    def leave(self) -> None:
        """Note that the browser has disconnected: nothing more is sent, and :meth:`release` is due."""
        self.has_left = True
        self._wake()

    def release(self) -> None:
        """Free the tiles that are drawn or on their way."""
        while self._drawn:
            self._drawn.popitem()[1].remove()

    def _add_controls(self) -> None:
        gui = self._client.gui
        self._state = gui.add_markdown("waiting for the first tile")
        self._coloring = gui.add_dropdown("colours", TILE_COLORINGS, initial_value="rgb")
        hint = f"distance from the base, or from the middle of the map; {VIEWER.no_crop:g} shows all"
        self._crop = gui.add_slider("crop, m", VIEWER.least_crop, VIEWER.no_crop, 0.1, VIEWER.no_crop, hint=hint)
        self._measure = gui.add_checkbox("measure", False, hint="click two points of the tiles that are loaded")
        self._distance = gui.add_markdown("")
        gui.add_markdown("\n\n".join(part for part in (_NOT_SHOWN, self._note) if part))

        @self._client.camera.on_update
        async def _(camera: viser.CameraHandle) -> None:
            self._camera = BrowserCamera.of(camera)
            self._change()

        @self._coloring.on_update
        async def _(_: Any) -> None:
            self._change()

        @self._crop.on_update
        async def _(_: Any) -> None:
            self._change()

        @self._measure.on_update
        async def _(_: Any) -> None:
            self._show_clicked([])

        @self._client.scene.on_click()
        def _(event: viser.SceneClickEvent) -> None:
            if self._measure.value:
                self._ray = np.asarray(event.ray_origin), np.asarray(event.ray_direction)
                self._wake()

    def _change(self) -> None:
        self._changed_s = time.monotonic()
        self._wake()

    def _show(self, cover: TileCover) -> None:
        """Remove the drawn tiles that are outside of a cover, then send those of it that are not drawn."""
        wanted: set[_Key] = {(number, self._coloring.value, float(self._crop.value)) for number in cover.numbers}
        lacking = {key: self._splats(*key) for key in sorted(wanted - self._drawn.keys())}
        with self._client.atomic():
            for key in self._drawn.keys() - wanted:
                self._drawn.pop(key).remove()
            for key, found in lacking.items():
                if len(found.centers) and not self.has_left:
                    name = f"/tiles/{key[0]}.{next(self._serials)}"
                    values = found.centers, found.covariances, found.rgbs, found.opacities
                    self._drawn[key] = self._client.scene.add_gaussian_splats(name, *values)
        self._state.content = self._described(cover)

    def _splats(self, number: int, coloring: Coloring, crop: float) -> Splats:
        return splats(self._cropped(number, crop), coloring, scale_of=self._overview)

    def _cropped(self, number: int, crop: float) -> GaussianModel:
        """Return the Gaussians of a tile within a distance of the middle [m]."""
        model = self._tiles.tile(number)
        return model if crop >= VIEWER.no_crop else model.select((model.means - self._middle).norm(dim=1) <= crop)

    def _described(self, cover: TileCover) -> str:
        """Return the loaded share of the map and the reached error in words."""
        count, tiles = sum(len(handle.buffer) for handle in self._drawn.values()), len(self._drawn)
        loaded = f"**{count:,} of {len(self._tiles):,} Gaussians** are loaded, in {tiles} tile{'s' * (tiles != 1)}."
        if np.isinf(cover.pixel_error):
            return f"{loaded} This is the coarsest level; finer tiles follow when the camera rests."
        reached = f"The pixel error is {cover.pixel_error:,.2f} px, and {self._pixel_error:g} px are requested."
        if cover.pixel_error > self._pixel_error:
            reached += f" The limit of {self._tiles.most_in_view:,} Gaussians a browser allows no less."
        return f"{loaded} {reached}"

    def _take_click(self, origin: Array, direction: Array) -> None:
        """Keep the point of the loaded tiles that a click means; a third click begins again."""
        shown = [self._cropped(number, crop) for number, _, crop in self._drawn]
        point = surface_point(GaussianModel.concatenate(shown), origin, direction) if shown else None
        if point is not None:
            self._show_clicked([*self._clicked, point] if len(self._clicked) < 2 else [point])

    def _show_clicked(self, points: list[Array]) -> None:
        self._clicked = points
        self._distance.content = show_distance(self._client.scene, points)
