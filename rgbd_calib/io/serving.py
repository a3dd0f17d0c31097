"""A web server for one user: a secret token in the address, a checked Host header, and a limit of connections.

A web page of another site can send requests to this computer and, by DNS rebinding, read the answers. Therefore the Host
header must name this computer, and every path starts with a token that only the printed address contains. Idle
connections cannot block the server: they time out, and at the limit the oldest connection is closed. waitress and
cheroot, the usual WSGI servers, stop accepting connections at their limits instead.
"""

from __future__ import annotations

import ipaddress
import logging
import secrets
import socket
import threading
from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import Any

from werkzeug.datastructures import Headers
from werkzeug.serving import ThreadedWSGIServer, WSGIRequestHandler
from werkzeug.wrappers import Response

from rgbd_calib.errors import ConfigError

LOOPBACK = "127.0.0.1"
MAX_CONNECTIONS = 64
"""Browsers open six to a server; a process may have 1,024 files open."""
SILENCE_S = 5.0
"""Longest pause of a connection while a request arrives, or an answer leaves."""
HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "default-src 'self' 'unsafe-inline' data:; frame-ancestors 'none'",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}
"""Of every answer: nothing is kept, nothing else is loaded, the address is told to nobody."""

Application = Callable[[dict[str, Any], Callable[..., Any]], Iterable[bytes]]


class LocalServer:
    """Serves a WSGI application from threads of its own; use as a context manager.

    Parameters
    ----------
    app
        Sees paths without the token. A browser must be given relative addresses only.
    host, port
        To listen on; port 0: any that is free.
    option
        Of the command line, for errors.

    Raises
    ------
    ConfigError
        The port is taken, or the host is not this computer's.
    """

    def __init__(self, app: Application, host: str, port: int, option: str) -> None:
        logging.getLogger("werkzeug").setLevel(logging.ERROR)
        token = secrets.token_hex(8)
        try:
            self._server = _Server(host, port, _guarded(app, host, token), _Handler)
        except (OSError, SystemExit) as error:  # werkzeug itself exits where a port is taken
            why = error.strerror or str(error) if isinstance(error, OSError) else "the port is taken"
            raise ConfigError(f"{option} {host}:{port}: cannot listen there ({why}). Choose another port") from None
        self._thread = threading.Thread(target=self._server.serve_forever, name="server", daemon=True)
        self.origin = f"http://{_shown(host)}:{self._server.server_port}"
        self.url = f"{self.origin}/{token}/"

    def __enter__(self) -> LocalServer:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()
        self._thread.join(2.0)
        self._server.server_close()


class _Server(ThreadedWSGIServer):
    """Threads for MAX_CONNECTIONS at most; for one more, the oldest is closed."""

    daemon_threads = True

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self._lock = threading.Lock()
        self._connections: dict[Any, None] = {}

    def process_request(self, request: Any, client_address: Any) -> None:
        with self._lock:
            self._connections[request] = None
            oldest = next(iter(self._connections)) if len(self._connections) > MAX_CONNECTIONS else None
            if oldest is not None:
                del self._connections[oldest]
        if oldest is not None:
            with suppress(OSError):
                oldest.shutdown(socket.SHUT_RDWR)  # its thread then reads the end, and closes it
        super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        with self._lock:
            self._connections.pop(request, None)
        super().shutdown_request(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A connection that fails is not worth a traceback."""


class _Handler(WSGIRequestHandler):
    timeout = SILENCE_S

    def log(self, type: str, message: str, *args: Any) -> None:
        """Requests are not worth a line each."""


def _guarded(app: Application, host: str, token: str) -> Application:
    """`app` for requests that name this computer and the token."""

    def guard(environ: dict[str, Any], start_response: Callable[..., Any]) -> Iterable[bytes]:
        def start(status: str, headers: list[tuple[str, str]], *more: Any) -> Any:
            return start_response(status, Headers([*Headers(headers), *_missing(headers)]).to_wsgi_list(), *more)

        first, slash, rest = environ.get("PATH_INFO", "").lstrip("/").partition("/")
        refusal: Response | None = None
        if not is_own_host(environ.get("HTTP_HOST", ""), host):
            refusal = Response("This server answers to addresses of its own computer only.\n", 421)
        elif not secrets.compare_digest(first.encode("utf-8", "replace"), token.encode()):
            refusal = Response("Open the address that rgbd-calib printed, with all that follows the port.\n", 403)
        elif not slash:
            refusal = Response(status=308, headers={"Location": f"/{token}/"})
        if refusal is not None:
            return refusal(environ, start)
        inside = environ | {"SCRIPT_NAME": f"{environ.get('SCRIPT_NAME', '')}/{token}", "PATH_INFO": f"/{rest}"}
        return app(inside, start)

    return guard


def _missing(headers: list[tuple[str, str]]) -> list[tuple[str, str]]:
    there = {name.lower() for name, _ in headers}
    return [(name, value) for name, value in HEADERS.items() if name.lower() not in there]


def is_own_host(header: str, bound: str) -> bool:
    """True where a Host header names this computer as a browser does that was sent here, not by a name of somebody else.

    On the loopback these are its addresses and `localhost`. Elsewhere every address in numbers is as good, since it is no
    name that somebody could turn to another address, and this computer's names are, too.
    """
    name = header.rpartition(":")[0] if header.rpartition(":")[2].isdigit() else header
    name = name.removeprefix("[").removesuffix("]").casefold()
    address = _address(name)
    if _is_loopback(bound):
        return name == "localhost" or (address is not None and address.is_loopback)
    own = socket.gethostname().casefold()
    return address is not None or name in ("localhost", bound.casefold(), own, f"{own.partition('.')[0]}.local")


def _address(text: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(text)
    except ValueError:
        return None


def _is_loopback(host: str) -> bool:
    address = _address(host)
    return host == "localhost" or (address is not None and address.is_loopback)


def _shown(host: str) -> str:
    """The host for a printed address; for all of this computer's addresses, the one that others see."""
    address = _address(host)
    if address is not None and address.is_unspecified:
        with suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.connect(("192.0.2.1", 9))  # sends nothing: the system chooses the address that it would send from
            return str(probe.getsockname()[0])
        return socket.gethostname()
    return f"[{host}]" if ":" in host else host
