"""The application: routes, limits and errors put together."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from fastapi import FastAPI

import splatbot
from splatbot.services.limits import BodyLimit
from splatbot.services.problems import install_problem_handlers
from splatbot.services.ros.node import RosNode
from splatbot.services.routes import distance, health, maps, render, ros
from splatbot.services.settings import ServiceSettings
from splatbot.services.store import MapStore

_DESCRIPTION = """
Questions about maps of 3D Gaussians. Lengths are metres in the map's world frame, quaternions are wxyz, camera axes are
OpenCV's (x right, y down, z forward). Every answer names the `map_version` it was computed on; errors are
`application/problem+json`.
"""


def create_app(settings: ServiceSettings, store: MapStore) -> FastAPI:
    """The service on the maps of ``store``, which others may go on writing to."""
    node = RosNode(store)

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        node.start()
        yield
        node.stop()

    app = FastAPI(title="splatbot", version=splatbot.__version__, description=_DESCRIPTION, lifespan=lifespan)
    app.state.ros = node
    app.state.settings = settings
    app.state.store = store
    app.add_middleware(BodyLimit, max_bytes=settings.max_body_bytes)
    install_problem_handlers(app)
    for group in (health, maps, distance, render, ros):
        app.include_router(group.router)
    return app
