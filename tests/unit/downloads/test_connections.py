"""Redirects, certificates, names, ports, proxies and secrets of an address."""

from __future__ import annotations

import socket
import subprocess
from pathlib import Path

import pytest

from splatbot.downloads import DownloadError
from splatbot.downloads.transfer import shown
from tests.unit.downloads.server import FileServer, cut, refuse
from tests.unit.downloads.transfers import CONTENT, StoppedError, get


@pytest.mark.parametrize(
    "place", ["http://127.0.0.1:1/a", "ftp://a/b", "file:///etc/passwd", "", "//", "https://", "/b"]
)
def test_redirects_lead_to_https_only(server: FileServer, tmp_path: Path, place: str) -> None:
    server.answers += [refuse(302, Location=place)]
    with pytest.raises(DownloadError, match="not https"):
        get(server.add("/a.tgz", CONTENT), tmp_path / "a")


@pytest.fixture
def certificate(tmp_path: Path) -> Path:
    """A PEM file with a key and a certificate of 127.0.0.1 that no authority signed."""
    path = tmp_path / "tls.pem"
    words = "req -x509 -newkey rsa:2048 -nodes -days 2 -subj /CN=localhost -addext subjectAltName=IP:127.0.0.1"
    keys = ["-keyout", str(tmp_path / "key.pem"), "-out", str(tmp_path / "cert.pem")]
    subprocess.run(["openssl", *words.split(), *keys], check=True, capture_output=True)
    path.write_bytes((tmp_path / "key.pem").read_bytes() + (tmp_path / "cert.pem").read_bytes())
    return path


def test_a_redirect_to_https_is_followed_and_continued(
    server: FileServer, tmp_path: Path, certificate: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SSL_CERT_FILE", str(certificate.with_name("cert.pem")))
    server.encrypt(certificate)
    server.add("/real.tgz", CONTENT)
    server.answers += [refuse(302, Location="/real.tgz"), cut(100_000), refuse(307, Location=server.base + "/real.tgz")]
    get(server.base + "/a.tgz", tmp_path / "a")
    assert (tmp_path / "a").read_bytes() == CONTENT
    assert server.ranges[-1] == "bytes=100000-"


def test_redirects_without_end_are_an_error(
    server: FileServer, tmp_path: Path, certificate: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SSL_CERT_FILE", str(certificate.with_name("cert.pem")))
    server.encrypt(certificate)
    server.answers += [refuse(302, Location="/a.tgz")] * 20
    with pytest.raises(DownloadError, match="without end"):
        get(server.base + "/a.tgz", tmp_path / "a")


def test_an_invalid_certificate_is_an_error_at_once(server: FileServer, tmp_path: Path, certificate: Path) -> None:
    server.encrypt(certificate)
    with pytest.raises(DownloadError, match=r"certificate of '127.0.0.1' is not valid"):
        get(server.add("/a.tgz", CONTENT), tmp_path / "a")


def test_an_unknown_host_is_an_error_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def unknown(*words: object, **options: object) -> None:
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", unknown)
    with pytest.raises(DownloadError, match=r"host 'nowhere.invalid' is not found.*HTTPS_PROXY"):
        get("https://nowhere.invalid/a.tgz", tmp_path / "a")


def test_a_name_server_that_fails_is_tried_again(
    server: FileServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real, failures = socket.getaddrinfo, [1, 2]

    def failing(*words: object, **options: object) -> object:
        if failures.pop() if failures else False:
            raise socket.gaierror(socket.EAI_AGAIN, "Temporary failure in name resolution")
        return real(*words, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(socket, "getaddrinfo", failing)
    get(server.add("/a.tgz", CONTENT), tmp_path / "a")
    assert (tmp_path / "a").read_bytes() == CONTENT


def test_a_closed_port_is_an_error_after_the_attempts(tmp_path: Path) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    with pytest.raises(DownloadError, match=r"connection to '127.0.0.1' failed .*3 attempts"):
        get(f"http://127.0.0.1:{port}/a.tgz", tmp_path / "a")


def test_proxies_of_the_environment_are_used(
    server: FileServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HTTP_PROXY", server.base)
    server.files["http://far.example/a.tgz"] = CONTENT
    get("http://far.example/a.tgz", tmp_path / "a")
    assert (tmp_path / "a").read_bytes() == CONTENT


def test_secrets_of_an_address_are_not_shown(server: FileServer, tmp_path: Path) -> None:
    address = server.add("/a.tgz", CONTENT).replace("http://", "http://ann:secret@")
    assert "secret" not in shown(address + "?token=secret#secret")
    with pytest.raises(StoppedError):
        get(address, tmp_path / "a", stop_at=1000)
    assert b"secret" not in (tmp_path / "a.json").read_bytes()
    server.answers += [refuse(404)]
    with pytest.raises(DownloadError) as raised:
        get(address, tmp_path / "b")
    assert "secret" not in str(raised.value)
