"""Liveness, readiness and metrics of the process."""

from __future__ import annotations

import importlib

from fastapi import APIRouter, Response

import splatbot
from splatbot.errors import NativeError
from splatbot.services.dependencies import Service, example, problems
from splatbot.services.problems import MapNotReadyError, NotReadyError
from splatbot.services.schemas import HealthResponse

router = APIRouter(tags=["health"])


@router.get("/healthz", responses=example({"status": "ok", "version": "0.1.0"}), response_model_exclude={"unsaved"})
async def healthz() -> HealthResponse:
    """Report that the process answers."""
    return HealthResponse(status="ok", version=splatbot.__version__)


@router.get(
    "/readyz",
    responses=example({"status": "ready", "version": "0.1.0", "unsaved": 0}) | problems(503),
)
async def readyz(service: Service) -> HealthResponse:
    """Check that the native module loads, the initial maps have a state, and the service is not ending."""
    try:
        importlib.import_module("splatbot._native")
    except ImportError as error:
        raise NativeError(
            f"cannot be loaded ({error}).", field="splatbot._native", hint="reinstall splatbot"
        ) from error
    if service.draining:
        raise NotReadyError("The service is about to end.", hint="ask another one")
    waiting = sum(m.awaited and m.snapshot is None for m in service.store.list())
    if waiting:
        raise MapNotReadyError(f"{waiting} of the initial maps have no state yet.", hint="see GET /v1/maps")
    unsaved = len(service.library.failing) if service.library is not None else 0
    return HealthResponse(status="ready", version=splatbot.__version__, unsaved=unsaved)


@router.get(
    "/metrics",
    response_class=Response,
    responses={200: {"content": {"text/plain": {"example": 'splatbot_map_gaussians{map="default"} 48213.0\n'}}}},
)
async def metrics(service: Service) -> Response:
    """Return the metrics for Prometheus."""
    text = await service.metrics.text_soon()
    return Response(text, media_type="text/plain; version=0.0.4; charset=utf-8")
