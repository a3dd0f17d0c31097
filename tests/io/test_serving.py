"""The server answers this computer's user alone, whoever else connects, and however many do."""

from __future__ import annotations

import http.client
import socket
import time
from collections.abc import Iterator
from contextlib import closing
from urllib.parse import urlsplit

import pytest

from rgbd_calib.errors import ConfigError
from rgbd_calib.io import serving
from rgbd_calib.io.serving import LOOPBACK, LocalServer, is_own_host


def app(environ, start_response):
    start_response("200 OK", [("Content-Type", "text/plain")])
    return [environ["PATH_INFO"].encode()]


@pytest.fixture
def server() -> Iterator[LocalServer]:
    with LocalServer(app, LOOPBACK, 0, "--preview") as running:
        yield running


def ask(server: LocalServer, path: str, host: str | None = None) -> http.client.HTTPResponse:
    address = urlsplit(server.url)
    with closing(http.client.HTTPConnection(address.hostname, address.port, timeout=20)) as connection:
        connection.putrequest("GET", path, skip_host=host is not None)
        if host is not None:
            connection.putheader("Host", host)
        connection.endheaders()
        answer = connection.getresponse()
        answer.body = answer.read()  # type: ignore[attr-defined]
        return answer


def test_the_printed_address_is_answered(server):
    path = urlsplit(server.url).path
    answer = ask(server, f"{path}state.json")
    assert answer.status == 200 and answer.body == b"/state.json"
    assert answer.headers["Referrer-Policy"] == "no-referrer" and answer.headers["Cache-Control"] == "no-store"
    assert "frame-ancestors 'none'" in answer.headers["Content-Security-Policy"]
    assert "Access-Control-Allow-Origin" not in answer.headers
    assert len(path.strip("/")) == 16  # 64 random bits
    to = ask(server, path.rstrip("/"))
    assert to.status == 308 and to.headers["Location"] == path


@pytest.mark.parametrize("path", ["/", "/state.json", "/0123456789abcdef/state.json", "//state.json", "/%ff/"])
def test_without_the_token_nothing_is_told(server, path):
    answer = ask(server, path)
    assert answer.status == 403 and b"state.json" not in answer.body


@pytest.mark.parametrize("host", ["evil.example", "evil.example:80", "127.0.0.1.evil.example", "", "192.0.2.1"])
def test_other_names_of_this_computer_are_refused(server, host):
    assert ask(server, urlsplit(server.url).path, host).status == 421


@pytest.mark.parametrize(
    ("header", "bound", "own"),
    [
        ("localhost:8765", "127.0.0.1", True),
        ("127.0.0.1", "127.0.0.1", True),
        ("[::1]:8765", "::1", True),
        ("192.168.0.7", "127.0.0.1", False),
        ("evil.example", "127.0.0.1", False),
        ("192.168.0.7:80", "0.0.0.0", True),
        ("[fe80::1]", "::", True),
        (socket.gethostname(), "0.0.0.0", True),
        ("evil.example", "0.0.0.0", False),
        ("localhost.evil.example", "0.0.0.0", False),
    ],
)
def test_hosts(header, bound, own):
    assert is_own_host(header, bound) == own


def test_idle_connections_keep_nobody_out(server):
    """Five times as many as are served, none of which says a word."""
    address = urlsplit(server.url)
    idle = [socket.create_connection((address.hostname, address.port)) for _ in range(5 * serving.MAX_CONNECTIONS)]
    try:
        begun = time.monotonic()
        assert ask(server, address.path).status == 200
        assert time.monotonic() - begun < serving.SILENCE_S
        assert len(server._server._connections) <= serving.MAX_CONNECTIONS
    finally:
        for connection in idle:
            connection.close()


def test_a_connection_that_says_nothing_is_closed(server, monkeypatch):
    monkeypatch.setattr(serving._Handler, "timeout", 0.2)
    address = urlsplit(server.url)
    with socket.create_connection((address.hostname, address.port), timeout=20) as connection:
        connection.sendall(b"GET / HT")
        assert connection.recv(100) == b""


def test_a_port_that_is_taken_is_an_error_for_people():
    with socket.socket() as taken:
        taken.bind((LOOPBACK, 0))
        taken.listen()
        with pytest.raises(ConfigError, match=r"--preview 127\.0\.0\.1:.*cannot listen there"):
            LocalServer(app, LOOPBACK, taken.getsockname()[1], "--preview")
