"""The image's health check against a real service, with and without TLS."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from splatbot.services.settings import ServiceSettings
from tests.container import health_check
from tests.contracts.conftest import running


def probe(url: str, *, tls: bool) -> int:
    """Return the exit code of the image's health check."""
    environment = os.environ | {"SPLATBOT_PORT": url.rsplit(":", 1)[1]} | ({"SPLATBOT_TLS_CERT": "x"} if tls else {})
    return subprocess.run(
        [sys.executable, *health_check()[1:]], env=environment, capture_output=True, timeout=60
    ).returncode


@pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl makes the certificate")
@pytest.mark.parametrize("tls", [False, True])
def test_the_health_check_works_with_and_without_tls(tls: bool, tmp_path: Path) -> None:
    cert, key = (tmp_path / "cert.pem", tmp_path / "key.pem") if tls else (None, None)
    if tls:
        make = ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes"]
        names = ["-days", "1", "-subj", "/CN=127.0.0.1", "-addext", "subjectAltName=IP:127.0.0.1"]
        subprocess.run([*make, *names, "-keyout", str(key), "-out", str(cert)], check=True, capture_output=True)
    with running(ServiceSettings(tls_cert=cert, tls_key=key)) as service:
        assert probe(service.url, tls=tls) == 0
    assert probe(service.url, tls=tls) != 0
