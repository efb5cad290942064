"""Which maps there are."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter

from splatbot.services.dependencies import Served, Store, example, problems
from splatbot.services.schemas import Bounds, MapInfo, MapList
from splatbot.services.store import ServedMap

router = APIRouter(prefix="/v1/maps", tags=["maps"])

_EXAMPLE: dict[str, Any] = {
    "id": "default",
    "map_version": 12,
    "state": "mapping",
    "detail": None,
    "source": "desk_log",
    "gaussians": 48213,
    "bytes": 3085632,
    "sh_degree": 0,
    "stamp": 1.3,
    "bounds": {"low": [-0.8, -0.5, 0.4], "high": [0.9, 0.4, 1.9]},
}


@router.get("", responses=example({"maps": [_EXAMPLE]}))
def list_maps(store: Store) -> MapList:
    """All maps as they are now."""
    return MapList(maps=[_info(served) for served in store.list()])


@router.get("/{map_id}", responses=example(_EXAMPLE) | problems(404))
def get_map(served: Served) -> MapInfo:
    """One map as it is now; `state` and `detail` tell how mapping its log goes."""
    return _info(served)


def _info(served: ServedMap) -> MapInfo:
    snapshot = served.snapshot
    bounds = None
    if snapshot is not None and len(snapshot.model):
        low, high = snapshot.model.means.aminmax(dim=0)
        bounds = Bounds(low=tuple(low.tolist()), high=tuple(high.tolist()))
    return MapInfo(
        id=served.id,
        map_version=served.map_version,
        state=served.state,
        detail=served.detail,
        source=served.source,
        gaussians=len(snapshot.model) if snapshot else 0,
        bytes=snapshot.model.nbytes if snapshot else 0,
        sh_degree=snapshot.model.sh_degree if snapshot else 0,
        stamp=snapshot.stamp if snapshot else 0.0,
        bounds=bounds,
    )
