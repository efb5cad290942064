"""A model behind HTTP: any endpoint with OpenAI's chat completions, within a time, a size, and no redirects."""

from __future__ import annotations

import base64
import contextlib
import http.client
import ipaddress
import json
import os
import socket
import ssl
import threading
from typing import Any
from urllib.parse import urlsplit

import cv2
import numpy as np

from splatbot.errors import InputError
from splatbot.grasping.vision.models import Picture, Question, VisionError, VisionTimeoutError

KEY, URL, MODEL = "SPLATBOT_VLM_KEY", "SPLATBOT_VLM_URL", "SPLATBOT_VLM_MODEL"
MOST = 1 << 20  # bytes of an answer
_QUALITY = 90  # of JPEG


class EndpointModel:
    """A :class:`splatbot.grasping.vision.VisionModel` at ``URL/chat/completions``.

    The key comes from the environment (SPLATBOT_VLM_KEY) when it is needed, is sent to no other place, never without
    encryption to another machine, and stands in no message. Proxies of the environment are not used.

    Args:
        url: as "https://api.example.com/v1", or "http://127.0.0.1:8000/v1".
        model: as the endpoint calls it.
        timeout: for one whole exchange [s].

    Raises:
        InputError: the address or the time-out makes no sense.
    """

    def __init__(self, url: str, model: str, *, timeout: float = 30.0) -> None:
        parts = urlsplit(url)
        plain = not (parts.username or parts.password or parts.query or parts.fragment)
        if parts.scheme not in ("http", "https") or not parts.hostname or not plain:
            raise InputError("is no address.", field="url", hint="give https://HOST/v1; the key goes into " + KEY)
        if not 0.0 < timeout < 3600.0:
            raise InputError(f"is {timeout}.", field="timeout", hint="give seconds")
        self._secure, self._host, self._port = parts.scheme == "https", parts.hostname, parts.port
        self._path = parts.path.rstrip("/") + "/chat/completions"
        self._model, self._timeout = model, timeout

    @classmethod
    def from_environment(cls, *, timeout: float = 30.0) -> EndpointModel:
        """As SPLATBOT_VLM_URL and SPLATBOT_VLM_MODEL say.

        Raises:
            InputError: they are not set.
        """
        missing = [name for name in (URL, MODEL) if not os.environ.get(name)]
        if missing:
            raise InputError("is not set.", field=", ".join(missing), hint="name an OpenAI-compatible endpoint")
        return cls(os.environ[URL], os.environ[MODEL], timeout=timeout)

    @property
    def name(self) -> str:
        """As results tell it."""
        return f"vlm:{self._model}@{self._host}"

    def ask(self, question: Question) -> str:
        """See :class:`splatbot.grasping.vision.VisionModel`.

        Raises:
            VisionTimeoutError: the exchange takes longer than the time-out.
            VisionError: no connection, a refusal, a redirect, too much, or no chat completion.
        """
        status, data = self._post(json.dumps(_request(self._model, question)).encode())
        if len(data) > MOST:
            raise VisionError(f"answers more than {MOST} bytes.", field=self.name)
        if status != 200:
            again = status == 429 or status >= 500
            raise VisionError(
                f"answers {status} {self._excerpt(data)}.", field=self.name, hint=_hint(status), again=again
            )
        try:
            content = json.loads(data)["choices"][0]["message"]["content"]
        except (ValueError, LookupError, TypeError, RecursionError):
            content = None
        if not isinstance(content, str):
            raise VisionError("answers with no chat completion.", field=self.name, hint="check the address", again=True)
        return content

    def _post(self, body: bytes) -> tuple[int, bytes]:
        """Status and body. A timer cuts the connection, for time-outs of sockets begin anew with every byte."""
        headers, connection = self._headers(), self._connection()
        cut = threading.Event()
        lines: list[socket.socket] = []

        def give_up() -> None:
            cut.set()
            for line in lines:
                with contextlib.suppress(OSError):  # it is closed by now
                    socket.socket.shutdown(line, socket.SHUT_RDWR)  # the line's own, also below TLS

        timer = threading.Timer(self._timeout, give_up)
        timer.start()
        try:
            connection.connect()
            lines.append(connection.sock)
            connection.request("POST", self._path, body, headers)
            response = connection.getresponse()
            data = response.read(MOST + 1)
        except (OSError, ValueError, http.client.HTTPException) as error:
            if cut.is_set() or isinstance(error, TimeoutError):
                raise self._late() from None
            reason = type(error).__name__
            raise VisionError(f"cannot be reached ({reason}).", field=self.name, hint="check the address") from None
        finally:
            timer.cancel()
            connection.close()
        if cut.is_set():
            raise self._late()
        return response.status, data

    def _late(self) -> VisionTimeoutError:
        return VisionTimeoutError(
            f"did not answer within {self._timeout:g} s.", field=self.name, hint="give a longer time-out"
        )

    def _connection(self) -> http.client.HTTPConnection:
        if self._secure:
            context = ssl.create_default_context()
            return http.client.HTTPSConnection(self._host, self._port, timeout=self._timeout, context=context)
        return http.client.HTTPConnection(self._host, self._port, timeout=self._timeout)

    def _headers(self) -> dict[str, str]:
        found = {"Content-Type": "application/json", "Accept": "application/json", "Connection": "close"}
        key = os.environ.get(KEY, "")
        if not key:
            return found
        if not (self._secure or _on_this_machine(self._host)):
            raise VisionError("would get the key without encryption.", field=self.name, hint="give an https address")
        if not key.isascii() or not key.isprintable():
            raise VisionError("is no key.", field=KEY, hint="give printable characters on one line")
        return found | {"Authorization": f"Bearer {key}"}

    def _excerpt(self, data: bytes) -> str:
        """The beginning of what an endpoint says, without the key, on one line."""
        key = os.environ.get(KEY, "")
        text = data[:2000].decode(errors="replace")
        text = "".join(c if c.isprintable() else " " for c in (text.replace(key, "***") if key else text))
        return repr(text[:120])


def _request(model: str, question: Question) -> dict[str, Any]:
    content: list[dict[str, Any]] = [{"type": "text", "text": question.text}]
    for k, picture in enumerate(question.pictures):
        content.append({"type": "text", "text": f"Picture {k}:"})
        content.append({"type": "image_url", "image_url": {"url": _data_url(picture)}})
    messages = [{"role": "system", "content": question.rules}, {"role": "user", "content": content}]
    return {"model": model, "messages": messages, "temperature": 0, "response_format": {"type": "json_object"}}


def _data_url(picture: Picture) -> str:
    ok, encoded = cv2.imencode(".jpg", np.ascontiguousarray(picture[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    if not ok:
        raise InputError(f"of shape {picture.shape} cannot be encoded.", field="picture", hint="give (H, W, 3) uint8")
    return "data:image/jpeg;base64," + base64.b64encode(encoded.tobytes()).decode()


def _hint(status: int) -> str:
    if 300 <= status < 400:
        return "redirects are not followed: give the address itself"
    return f"check {KEY}" if status in (401, 403) else "check the address and the model's name"


def _on_this_machine(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
