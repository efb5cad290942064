"""The application: routes, limits and errors put together."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from anyio.to_thread import current_default_thread_limiter
from fastapi import Depends, FastAPI
from starlette.concurrency import run_in_threadpool
from starlette.middleware.cors import CORSMiddleware

import splatbot
from splatbot.priority import lower_priority, switch_quickly
from splatbot.services.access import Access
from splatbot.services.codecs import describe_bodies
from splatbot.services.docs import add_docs
from splatbot.services.guard import Guard
from splatbot.services.integrations import Integrations
from splatbot.services.limits import BodyLimit
from splatbot.services.problems import install_problem_handlers
from splatbot.services.queues import THREADS, Queues
from splatbot.services.requests import HEADER, RequestLog
from splatbot.services.routes import (
    arms,
    collisions,
    distance,
    frames,
    grasps,
    health,
    jobs,
    landing,
    maps,
    merging,
    objects,
    picks,
    plans,
    quota,
    render,
    robots,
    ros,
    trajectories,
    trials,
    versions,
    views,
)
from splatbot.services.runtime import Runtime
from splatbot.services.scopes import check_scope

_DESCRIPTION = """
Questions about maps of 3D Gaussians. Lengths are metres in the map's world frame, angles radians, quaternions wxyz,
camera axes OpenCV's (x right, y down, z forward). Every answer names the `map_version` it was computed on; errors are
`application/problem+json`. Arrays may travel as `application/x-npy` or `application/msgpack` instead of JSON.
"""


def create_app(runtime: Runtime) -> FastAPI:
    """Create the service on ``runtime``, which starts and stops with the application."""
    settings = runtime.settings
    access = Access(settings)
    integrations = Integrations(
        settings,
        access,
        runtime.store,
        runtime.arms,
        on_frame=runtime.take,
        on_joints=runtime.report_joints,
        find_transform=runtime.find_transform,
    )

    @asynccontextmanager
    async def lifespan(_app: FastAPI) -> AsyncIterator[None]:
        lower_priority(settings.niceness)  # this thread starts all those that answer
        switch_quickly()
        current_default_thread_limiter().total_tokens = THREADS
        await run_in_threadpool(integrations.start)
        await run_in_threadpool(runtime.start)
        yield
        await run_in_threadpool(integrations.stop)
        await run_in_threadpool(runtime.close)

    app = FastAPI(
        title="splatbot",
        version=splatbot.__version__,
        description=_DESCRIPTION,
        docs_url=None,
        redoc_url=None,
        lifespan=lifespan,
        dependencies=[Depends(check_scope)],
    )
    app.state.runtime = runtime
    app.state.ros = integrations.ros
    # The last one added is the first to see a request.
    uploads = {"/upload": settings.max_upload_bytes}
    app.add_middleware(Queues, most_waiting=settings.max_waiting, body_s=settings.body_s)
    app.add_middleware(BodyLimit, max_bytes=settings.max_body_bytes, larger=uploads)
    app.add_middleware(Guard, settings=settings, access=access)
    if settings.cors_origins:
        headers = ["Authorization", "Content-Type", "X-API-Key", "Idempotency-Key", HEADER]
        app.add_middleware(
            CORSMiddleware, allow_origins=settings.cors_origins, allow_methods=["*"], allow_headers=headers
        )
    app.add_middleware(RequestLog, counter=runtime.metrics)
    install_problem_handlers(app)
    describe_bodies(app)
    add_docs(app)
    for group in (
        landing,
        health,
        maps,
        frames,
        versions,
        merging,
        distance,
        collisions,
        render,
        views,
        plans,
        grasps,
        objects,
        robots,
        picks,
        arms,
        trajectories,
        trials,
        jobs,
        quota,
        ros,
    ):
        app.include_router(group.router)
    return app
