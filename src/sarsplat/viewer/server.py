"""viser's web server, kept on this machine: one port or none, no stranger's page, nothing loaded from elsewhere."""

from __future__ import annotations

import io
import os
import re
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from importlib.resources import files
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qs, urlsplit

from sarsplat.errors import SarsplatError, shown

if TYPE_CHECKING:
    import viser
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request, Response

HOST = "127.0.0.1"
_NAMES = (HOST, "localhost", "[::1]")
"""What a browser on this machine may call it; also one at the other end of a tunnel, whose port may be another."""

_TITLE = "sarsplat"

_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline' 'unsafe-eval' blob: data:; style-src 'unsafe-inline'; "
    "worker-src blob: data:; img-src blob: data:; font-src blob: data:; "
    "connect-src 'self' {sockets} blob: data:; frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
)
"""Content-Security-Policy: whatever the page's scripts would like, the browser asks nobody but this server."""


_OWN = re.compile(rf"(?:{'|'.join(map(re.escape, _NAMES))})(?::[0-9]{{1,5}})?", re.IGNORECASE | re.ASCII)
_STARTING = threading.Lock()


def start_server(port: int, on_pick: Callable[[float, float], None]) -> viser.ViserServer:
    """Serve a page on a port of 127.0.0.1; 0 takes any free one.

    `on_pick` gets where the page's picture was clicked: parts of its width and height, from the upper left. It runs in
    the server's thread and must return at once. Raises `SarsplatError` if the port is taken or not allowed.
    """
    import viser

    listener = _bound(port)
    number = listener.getsockname()[1]
    try:
        # viser prints its address in a box
        with _STARTING, _served_on(listener, number, on_pick), redirect_stdout(io.StringIO()):
            return viser.ViserServer(host=HOST, port=number, label=_TITLE, verbose=False)
    except BaseException:
        listener.close()
        raise


def stop_server(server: viser.ViserServer) -> None:
    """Stop serving; viser's message about it is suppressed."""
    with redirect_stdout(io.StringIO()):
        server.stop()


def _bound(port: int) -> socket.socket:
    if not 0 <= port < 65536:
        raise SarsplatError(f"port {port} is not a valid port; give a number from 1024 to 65535")
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    if os.name == "posix":  # of a server that has just ended; elsewhere this would take the port from a living one
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((HOST, port))
        listener.listen()
    except OSError as error:
        listener.close()
        raise SarsplatError(
            f"port {port} of this machine cannot be used ({(error.strerror or str(error)).lower()}); choose another"
        ) from error
    return listener


@contextmanager
def _served_on(listener: socket.socket, number: int, on_pick: Callable[[float, float], None]) -> Iterator[None]:
    """While viser starts: it serves on this socket, and not on the next free port as it otherwise would.

    Its pages then say what the browser may load, and only they may open a connection: any site that is open in the
    same browser could otherwise listen in. Nor is anything answered that was asked of another name: a stranger's name
    can be made to mean this machine (DNS rebinding), and then its pages would be ours. viser passes nothing of this on
    to websockets, so its call of `serve` is intercepted: that with our port alone, one start at a time. Whoever else
    serves something meanwhile is unaffected.
    """
    from websockets.asyncio import server as library

    real, addition = library.serve, files("sarsplat.viewer").joinpath("page.html").read_bytes()

    def serve(handler: Any, host: str | None = None, port: int | None = None, **options: Any) -> Any:
        if (host, port) != (HOST, number):
            return real(handler, host, port, **options)
        process_request = options.pop("process_request")

        def asked(connection: ServerConnection, request: Request) -> Response | None:
            if (refusal := _foreign(request)) is not None:
                return connection.respond(403, refusal)
            if urlsplit(request.path).path == "/pick":
                return _picked(connection, request, on_pick)
            if "Accept-Encoding" in request.headers:
                del request.headers["Accept-Encoding"]  # on one machine, packing only takes time
            response: Response | None = process_request(connection, request)
            return response

        def answered(connection: ServerConnection, request: Request, response: Response) -> None:
            if response.headers.get("Content-Type", "").startswith("text/html"):
                response.body = response.body.replace(b"<title>Viser</title>", b"<title>sarsplat view</title>")
                response.body = response.body.replace(b"</head>", addition + b"</head>", 1)
                response.headers.pop("Content-Length")
                response.headers["Content-Length"] = str(len(response.body))
                response.headers["Content-Security-Policy"] = _POLICY.format(sockets=f"ws://{request.headers['Host']}")
                response.headers["Referrer-Policy"] = "no-referrer"

        own_options: dict[str, Any] = {"process_request": asked, "process_response": answered}
        return real(handler, sock=listener, **own_options, **options)

    library.serve = serve  # type: ignore[misc, assignment]
    try:
        yield
    finally:
        library.serve = real  # type: ignore[misc]


def _foreign(request: Request) -> str | None:
    """Why a request is not answered, if it was asked of another name than this machine's, or by another site's page.

    A page says what site it is of whenever it opens a socket; programs that are no browsers say nothing.
    """
    hosts, origins = (request.headers.get_all(name) for name in ("Host", "Origin"))
    if len(hosts) != 1 or not _OWN.fullmatch(hosts[0]):
        return f"this page is at http://{HOST} or http://localhost only, not {shown(', '.join(hosts) or 'nowhere')}\n"
    if any(origin.lower() != f"http://{hosts[0].lower()}" for origin in origins):
        return f"a page of {shown(', '.join(origins))} may not ask for this\n"
    return None


def _picked(connection: ServerConnection, request: Request, on_pick: Callable[[float, float], None]) -> Response:
    words = parse_qs(urlsplit(request.path).query)
    try:
        x, y = (float(words[name][0]) for name in ("x", "y"))
    except (KeyError, ValueError):
        return connection.respond(400, "x and y are missing\n")
    if not (0 <= x < 1 and 0 <= y < 1) or request.headers.get("Sec-Fetch-Site", "same-origin") != "same-origin":
        return connection.respond(400, "not a place in the picture\n")
    on_pick(x, y)
    return connection.respond(204, "")
