"""Vision-language model behind an OpenAI-compatible HTTP endpoint, with limits on time, size and redirects."""

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
MAX_ANSWER_BYTES = 1 << 20
_JPEG_QUALITY = 90


class EndpointModel:
    """A :class:`splatbot.grasping.vision.VisionModel` at ``URL/chat/completions``.

    The key is read from the environment variable SPLATBOT_VLM_KEY for each request. It is sent only to this endpoint,
    only over TLS unless the endpoint is local, and never appears in a message. Proxies of the environment are ignored.

    Args:
        url: base URL such as "https://api.example.com/v1" or "http://127.0.0.1:8000/v1".
        model: name of the model at the endpoint.
        timeout: limit for one whole exchange [s].

    Raises:
        InputError: the address or the timeout is invalid.
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
        self.name = f"vlm:{model}@{self._host}"

    @classmethod
    def from_environment(cls, *, timeout: float = 30.0) -> EndpointModel:
        """Create a model from SPLATBOT_VLM_URL and SPLATBOT_VLM_MODEL.

        Raises:
            InputError: a variable is not set.
        """
        missing = [name for name in (URL, MODEL) if not os.environ.get(name)]
        if missing:
            raise InputError("is not set.", field=", ".join(missing), hint="name an OpenAI-compatible endpoint")
        return cls(os.environ[URL], os.environ[MODEL], timeout=timeout)

    def ask(self, question: Question) -> str:
        """Send the question; see :class:`splatbot.grasping.vision.VisionModel`.

        Raises:
            VisionTimeoutError: the exchange takes longer than the timeout.
            VisionError: no connection, an HTTP error, a redirect, an answer above 1 MiB, or no chat completion.
        """
        status, data = self._post(json.dumps(_request(self._model, question)).encode())
        if len(data) > MAX_ANSWER_BYTES:
            raise VisionError(f"answers more than {MAX_ANSWER_BYTES} bytes.", field=self.name)
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
        """Send a request and return status and body.

        A timer closes the connection, since socket timeouts restart with every byte.
        """
        headers, connection = self._headers(), self._connection()
        cut = threading.Event()
        lines: list[socket.socket] = []

        def give_up() -> None:
            cut.set()
            for line in lines:
                with contextlib.suppress(OSError):  # the socket may be closed already
                    socket.socket.shutdown(line, socket.SHUT_RDWR)  # of the TCP socket, also below TLS

        timer = threading.Timer(self._timeout, give_up)
        timer.start()
        try:
            connection.connect()
            lines.append(connection.sock)
            connection.request("POST", self._path, body, headers)
            response = connection.getresponse()
            data = response.read(MAX_ANSWER_BYTES + 1)
        except (OSError, ValueError, http.client.HTTPException) as error:
            if cut.is_set() or isinstance(error, TimeoutError):
                raise self._timed_out() from None
            reason = type(error).__name__
            raise VisionError(f"cannot be reached ({reason}).", field=self.name, hint="check the address") from None
        finally:
            timer.cancel()
            connection.close()
        if cut.is_set():
            raise self._timed_out()
        return response.status, data

    def _timed_out(self) -> VisionTimeoutError:
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
        """Return the beginning of an answer on one line, without the key."""
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
    ok, encoded = cv2.imencode(
        ".jpg", np.ascontiguousarray(picture[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
    )
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
