"""The observer of a training that draws for the browsers, within a share of the time."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass

from splatbot.errors import SplatbotError
from splatbot.services.live_training.budget import CONSTANTS as BUDGET
from splatbot.services.live_training.budget import Clock, ImageCosts, ViewerBudget
from splatbot.services.live_training.course import TrainingCourse
from splatbot.services.live_training.images import draw, jpeg, photograph, photographed_by, up_direction, widths
from splatbot.services.live_training.requests import LiveRequest
from splatbot.services.live_training.server import LiveClient, LivePage, message
from splatbot.training.session import TrainingSession


@dataclass(frozen=True)
class LiveTrainingConstants:
    """Constants of the viewer of a training.

    Args:
        moving: [s] time between two pictures of a camera that moves; it bounds their size.
        resting: [s] time between two pictures of a camera that rests.
        status: [s] time between two messages with curves and numbers.
        status_cost: [s] predicted cost of such a message.
        pixel_cost: [s] predicted cost of a pixel of the first photograph, which is decoded.
    """

    moving: float = 0.25
    resting: float = 1.0
    status: float = 1.0
    status_cost: float = 1e-3
    pixel_cost: float = 5e-8


CONSTANTS = LiveTrainingConstants()


class LiveTraining:
    """Shows a training on a page: call it after each step, in the thread that trains.

    A step is followed by at most one image for one browser. All its time counts, and that of the server's thread.

    Args:
        session: the training.
        page: that shows it.
        name: of the training in the page.
        clock: of the account of time.
    """

    def __init__(
        self, session: TrainingSession, page: LivePage, name: str, *, clock: Clock = time.perf_counter
    ) -> None:
        self.budget = ViewerBudget(clock)
        self._session, self._page = session, page
        self._course = TrainingCourse(session.rows)
        self._pictures, self._photographs = ImageCosts(), ImageCosts()
        self._charged_s, self._step_s, self._seconds = page.busy_s, 0.0, session.seconds
        views = [*session.images.views, *session.held_out.views]
        scene = {
            "name": name,
            "trained": len(session.images.views),
            "views": [[v.name, v.camera.width, v.camera.height, v.camera.fx] for v in views],
            "up": up_direction(session),
        }
        page.show(scene, len(views))

    def __call__(self, loss: float) -> None:
        """Note a step, and send the messages that are due, if the budget covers them."""
        began = self.budget.clock()
        seconds = self._session.seconds
        self._course.note(loss, seconds, len(self._session.trainer.model))
        self._step_s, self._seconds = seconds - self._seconds, seconds
        clients = sorted(self._page.clients, key=lambda client: client.shown_s)
        for client in clients:
            if began - client.status_s >= CONSTANTS.status and self.budget.covers(CONSTANTS.status_cost):
                client.put("status", self._status(ended=False))
                client.status_s = began
            if self._send_image(client, began, len(clients)):
                break
        busy = self._page.busy_s
        self.budget.spend(self.budget.clock() - began + busy - self._charged_s)
        self._charged_s = busy

    def end(self) -> None:
        """Announce the last numbers."""
        self._page.announce("status", self._status(ended=True))

    def _send_image(self, client: LiveClient, now: float, clients: int) -> bool:
        """Send a client the image that is due and covered; return whether there was one."""
        request = client.request
        if request is None or client.waits_for_image:
            return False
        if client.photographed != (request.view, request.width):
            return self._send_photograph(client, request)
        moved = request is not client.shown
        rested = now - client.shown_s >= CONSTANTS.resting
        if not moved and not (rested and self._session.trainer.iteration > client.shown_iteration):
            return False
        return self._send_picture(client, request, now, (CONSTANTS.moving if moved else CONSTANTS.resting) / clients)

    def _send_photograph(self, client: LiveClient, request: LiveRequest) -> bool:
        camera = photographed_by(self._session, request.view)
        unknown = CONSTANTS.pixel_cost * camera.width * camera.height
        if not self.budget.covers(self._photographs.predict(camera.width, unknown)):
            return False
        began = self.budget.clock()
        client.photographed = (request.view, request.width)
        try:
            image = photograph(self._session, request)
        except SplatbotError as error:
            client.put("problem", message("problem", {"text": str(error)}))
            return True
        client.put("photo", message("photo", {"view": request.view, "image": jpeg(image)}))
        self._photographs.note(camera.width, self.budget.clock() - began)
        return True

    def _send_picture(self, client: LiveClient, request: LiveRequest, now: float, period_s: float) -> bool:
        """Send a picture of the size that the budget allows each ``period_s`` [s]."""
        width = self._pictures.largest(widths(self._session, request), BUDGET.share * period_s, self._step_s)
        if not self.budget.covers(self._pictures.predict(width, self._step_s)):
            return False
        began = self.budget.clock()
        picture = draw(self._session, request, width)
        values = {
            "view": request.view,
            "own_pose": request.pose is None,
            "image": jpeg(picture.image),
            "width": width,
            "pose": picture.pose.ravel().tolist(),
            "distance": picture.distance,
            "iteration": self._session.trainer.iteration,
        }
        client.put("picture", message("picture", values))
        client.shown, client.shown_s, client.shown_iteration = request, now, self._session.trainer.iteration
        self._pictures.note(width, self.budget.clock() - began)
        return True

    def _status(self, *, ended: bool) -> str:
        session = self._session
        psnr = [[row.seconds, row.psnr_db] for row in session.rows if row.psnr_db is not None]
        values = {
            "ended": ended,
            "iteration": session.trainer.iteration,
            "iterations": session.options.iterations,
            "share": session.share,
            "seconds": session.seconds,
            "remaining_s": session.remaining_s,
            "gaussians": len(session.trainer.model),
            "viewer_share": self.budget.used,
            "most_viewer_share": BUDGET.share,
            "course": [list(asdict(point).values()) for point in self._course.points],
            "psnr": psnr,
        }
        return message("status", values)
