"""Bodies in JSON, msgpack or npy, by the Content-Type and Accept headers of a request."""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Coroutine, Mapping
from typing import Any, TypeVar

import msgpack
import numpy as np
from fastapi import FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from numpy.lib import format as npy
from numpy.typing import NDArray
from pydantic import BaseModel, ValidationError
from pydantic.json_schema import models_json_schema
from pydantic_core import to_json
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException

from splatbot.client import pack_array
from splatbot.errors import InputError
from splatbot.services.bounds import INLINE_BYTES, check_json, check_msgpack
from splatbot.services.settings import ServiceSettings

JSON = "application/json"
NPY = "application/x-npy"
MSGPACK = "application/msgpack"
ZIP = "application/zip"

_M = TypeVar("_M", bound=BaseModel)
_KINDS = "biuf"  # of numpy's dtypes that travel
_MOST = 2**31  # entries of an array
_VALUES = 10_000  # of a body, unless its route takes more
_BODIES: dict[str, type[BaseModel]] = {}


def body_of(
    model: type[_M], *, array: str | None = None, values: Callable[[ServiceSettings], int] = lambda _: _VALUES
) -> Callable[[Request], Coroutine[Any, Any, _M]]:
    """Return a dependency that reads a ``model`` from a body of any of the three kinds.

    A body with more than ``values`` values is refused before objects are made of it.

    Args:
        model: of the body.
        array: the field that a bare npy array fills. If None, npy is refused.
        values: limit of a body; a list or object counts as four, see :mod:`splatbot.services.bounds`.
    """
    _BODIES[model.__name__] = model

    def decode(kind: str, body: bytes, most: int) -> _M:
        context = {"values": most}
        try:
            if kind == NPY and array is not None:
                return model.model_validate({array: decode_npy(body)}, context=context)
            if kind == MSGPACK:
                check_msgpack(body, most)
                return model.model_validate(decode_msgpack(body), context=context)
            if kind == JSON:
                check_json(body, most)
                return model.model_validate_json(body)
        except ValidationError as error:
            found = error.errors(include_url=False, include_context=False, include_input=False)
            raise RequestValidationError([e | {"loc": ("body", *e["loc"])} for e in found]) from error
        taken = ", ".join([JSON, MSGPACK, *([NPY] if array is not None else [])])
        raise HTTPException(415, f"The body is {kind[:80]!r}; taken are {taken}.")

    async def read(request: Request) -> _M:
        kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
        body, most = await request.body(), values(request.app.state.runtime.settings)
        if len(body) <= INLINE_BYTES:
            return decode(kind, body, most)
        return await run_in_threadpool(decode, kind, body, most)

    return read


def request_body(model: type[BaseModel], examples: Mapping[str, Any], *, npy: str = "") -> dict[str, Any]:
    """Return the OpenAPI entry of a request's body; ``npy`` describes a bare array."""
    schema = {"$ref": f"#/components/schemas/{model.__name__}"}
    content: dict[str, Any] = {
        JSON: {"schema": schema, "examples": {name: {"value": dict(value)} for name, value in examples.items()}},
        MSGPACK: {"schema": schema | {"description": "arrays as {dtype, shape, data}"}},
    }
    if npy:
        content[NPY] = {"schema": {"type": "string", "format": "binary", "description": npy}}
    return {"requestBody": {"required": True, "content": content}}


def answers(example: Mapping[str, Any], *, npy: str = "") -> dict[int | str, dict[str, Any]]:
    """Return the OpenAPI entry of an answer; ``npy`` describes a bare array."""
    content: dict[str, Any] = {
        JSON: {"example": dict(example)},
        MSGPACK: {"schema": {"type": "string", "format": "binary", "description": "arrays as {dtype, shape, data}"}},
    }
    if npy:
        content[NPY] = {"schema": {"type": "string", "format": "binary", "description": npy}}
    return {200: {"content": content, "description": "in the kind that `Accept` names; JSON by default"}}


def answer(
    request: Request, body: Mapping[str, Any], *, array: str | None = None, headers: Mapping[str, str] | None = None
) -> Response:
    """Encode ``body`` in the kind that the request accepts; infinity and NaN become null in JSON.

    Args:
        array: the entry that is sent alone where npy is accepted.
    """
    accepted = request.headers.get("accept", "")
    all_headers = dict(headers or {})
    if "map_version" in body:
        all_headers["X-Map-Version"] = str(body["map_version"])
    if array is not None and NPY in accepted:
        return Response(encode_npy(body[array]), media_type=NPY, headers=all_headers)
    if MSGPACK in accepted:
        return Response(msgpack.packb(body, default=pack_array), media_type=MSGPACK, headers=all_headers)
    text = to_json(body, inf_nan_mode="null", fallback=plain)
    return Response(text, media_type=JSON, headers=all_headers)


def decode_npy(body: bytes) -> NDArray[Any]:
    """Decode an npy file; arrays of objects, which need pickle, are refused.

    Raises:
        InputError: it is no npy file, of another kind of number, or shorter or longer than it says.
    """
    stream = io.BytesIO(body)
    try:
        version = npy.read_magic(stream)
        if version not in ((1, 0), (2, 0)):
            raise ValueError(f"npy version {version}")
        read = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
        shape, fortran, dtype = read(stream)
    except Exception as error:  # numpy reads the header with Python's own tokenizer, which raises as it likes
        raise InputError("is no npy array.", field="body", hint="send the output of numpy.save") from error
    return _array(body[stream.tell() :], dtype, shape, "F" if fortran else "C")


def encode_npy(array: NDArray[Any]) -> bytes:
    """Encode an array as an npy file."""
    stream = io.BytesIO()
    np.save(stream, array, allow_pickle=False)
    return stream.getvalue()


def decode_msgpack(body: bytes) -> Any:
    """Decode a msgpack body with its arrays.

    Raises:
        InputError: the body is not msgpack, or an array does not match its header.
    """
    try:
        return msgpack.unpackb(body, object_hook=_unpacked, strict_map_key=True, max_ext_len=0)
    except InputError:
        raise
    except (ValueError, TypeError, msgpack.UnpackException, RecursionError) as error:
        raise InputError("is no msgpack.", field="body", hint="send a map with text keys") from error


def plain(value: Any) -> Any:
    """Convert a value to one that JSON can hold."""
    if isinstance(value, np.ndarray):
        if value.dtype.kind == "f" and not np.isfinite(value).all():
            values = value.astype(object)
            values[~np.isfinite(value)] = None
            return values.tolist()
        return value.tolist()
    if isinstance(value, np.generic):
        return plain(np.asarray(value))
    if isinstance(value, float):
        return value if np.isfinite(value) else None
    if isinstance(value, Mapping):
        return {name: plain(part) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [plain(part) for part in value]
    return value


def describe_bodies(app: FastAPI) -> None:
    """Let the OpenAPI document name the models that :func:`request_body` refers to, and how a key is sent."""
    original = app.openapi

    def described() -> dict[str, Any]:
        if app.openapi_schema is None:
            document = original()
            _, found = models_json_schema(
                [(model, "validation") for model in _BODIES.values()], ref_template="#/components/schemas/{model}"
            )
            document.setdefault("components", {}).setdefault("schemas", {}).update(found.get("$defs", {}))
            document["components"]["securitySchemes"] = {"key": {"type": "http", "scheme": "bearer"}}
            document["security"] = [{"key": []}, {}]
            app.openapi_schema = document
        return app.openapi_schema

    app.openapi = described  # type: ignore[method-assign]


def _unpacked(value: dict[str, Any]) -> Any:
    if set(value) != {"dtype", "shape", "data"}:
        return value
    dtype, shape, data = value["dtype"], value["shape"], value["data"]
    if not (isinstance(dtype, str) and len(dtype) <= 20 and isinstance(data, bytes) and isinstance(shape, list)):
        raise InputError("is no array.", field="dtype, shape, data", hint="text, whole numbers, bytes")
    try:
        kind = np.dtype(dtype)
    except (TypeError, ValueError, SyntaxError) as error:
        raise InputError(f"is {dtype[:20]!r}.", field="dtype", hint='give e.g. "<f4"') from error
    return _array(data, kind, tuple(shape), "C")


def _array(data: bytes, dtype: np.dtype[Any], shape: tuple[int, ...], order: Any) -> NDArray[Any]:
    if dtype.kind not in _KINDS or dtype.itemsize > 8 or dtype.subdtype is not None:
        raise InputError(f"is {str(dtype)[:40]}.", field="dtype", hint="send numbers, e.g. <f4 or |u1")
    whole = len(shape) <= 4 and all(type(n) is int and n >= 0 for n in shape)  # True is no length
    # Lengths next to a 0 are bounded too: numpy cannot hold an empty array of any shape.
    if not whole or math.prod(max(n, 1) for n in shape) > _MOST or math.prod(shape) * dtype.itemsize != len(data):
        hint = "give at most four whole numbers, and as many bytes as they say"
        raise InputError(f"{len(data)} bytes are not {str(shape)[:60]} of {dtype}.", field="shape", hint=hint)
    return np.frombuffer(data, dtype).reshape(shape, order=order)
