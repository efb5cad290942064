"""Whether the process lives and whether it can answer."""

from __future__ import annotations

import importlib

from fastapi import APIRouter

import splatbot
from splatbot.errors import NativeError
from splatbot.services.dependencies import Store, example, problems
from splatbot.services.problems import MapNotReadyError
from splatbot.services.schemas import Health

router = APIRouter(tags=["health"])


@router.get("/healthz", responses=example({"status": "ok", "version": "0.1.0", "maps": {"default": 3}}))
def healthz(store: Store) -> Health:
    """Alive: the process answers."""
    return Health(status="ok", version=splatbot.__version__, maps=_versions(store))


@router.get(
    "/readyz",
    responses=example({"status": "ready", "version": "0.1.0", "maps": {"default": 3}}) | problems(503),
)
def readyz(store: Store) -> Health:
    """Ready: the native module loads and at least one map has a state."""
    try:
        importlib.import_module("splatbot._native")
    except ImportError as error:
        raise NativeError(
            f"cannot be loaded ({error}).", field="splatbot._native", hint="reinstall splatbot"
        ) from error
    versions = _versions(store)
    if not versions:
        raise MapNotReadyError("No map has a state yet.", hint="GET /v1/maps tells how far mapping is")
    return Health(status="ready", version=splatbot.__version__, maps=versions)


def _versions(store: Store) -> dict[str, int]:
    return {m.id: m.map_version for m in store.list() if m.snapshot is not None}
