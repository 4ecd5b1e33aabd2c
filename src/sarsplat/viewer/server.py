"""viser's web server on the loopback interface, closed to other sites' pages, and the thread that draws for it."""

from __future__ import annotations

import io
import logging
import os
import re
import socket
import threading
from collections.abc import Callable, Iterator
from concurrent import futures
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
"""Host names under which the page is served, on any port: an SSH tunnel may change it."""

_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline' 'unsafe-eval' blob: data:; style-src 'unsafe-inline'; "
    "worker-src blob: data:; img-src blob: data:; font-src blob: data:; "
    "connect-src 'self' {sockets} blob: data:; frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
)
"""Content-Security-Policy: the browser only connects to this server."""

_OWN = re.compile(rf"(?:{'|'.join(map(re.escape, _NAMES))})(?::[0-9]{{1,5}})?", re.IGNORECASE | re.ASCII)
_STARTING = threading.Lock()


def start_server(port: int, on_pick: Callable[[float, float], None]) -> viser.ViserServer:
    """Serve a page on a port of 127.0.0.1; 0 takes any free one.

    `on_pick` gets the position of a click on the page's picture, relative to its width and height, from the upper left.
    It runs in the server's thread and must return at once. Raises if the port is taken or not allowed.
    """
    import viser

    listener = _bound(port)
    number = listener.getsockname()[1]
    try:
        # viser prints its address in a box
        with _STARTING, _served_on(listener, number, on_pick), redirect_stdout(io.StringIO()):
            return viser.ViserServer(host=HOST, port=number, label="sarsplat", verbose=False)
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
    if os.name == "posix":  # reuse the port of a server that has just ended; Windows would share a busy port
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
    """Make viser, which starts inside the block, serve on this socket instead of the next free port, and more safely.

    Pages get a Content-Security-Policy, and requests are rejected if their origin is another site or their host name is
    not this machine's (DNS rebinding): any site open in the same browser could otherwise connect. viser has no options
    for this, so websockets' `serve` is patched for the call with this port, one start at a time; other calls are
    unaffected.
    """
    from websockets.asyncio import server as library

    real, addition = library.serve, files("sarsplat.viewer").joinpath("page.html").read_bytes()

    def serve(handler: Any, host: str | None = None, port: int | None = None, **options: Any) -> Any:
        if (host, port) != (HOST, number):
            return real(handler, host, port, **options)
        process_request = options.pop("process_request")

        def on_request(connection: ServerConnection, request: Request) -> Response | None:
            if (reason := _rejection(request)) is not None:
                return connection.respond(403, reason)
            if urlsplit(request.path).path == "/pick":
                return _picked(connection, request, on_pick)
            if "Accept-Encoding" in request.headers:
                del request.headers["Accept-Encoding"]  # compression only takes time on one machine
            response: Response | None = process_request(connection, request)
            return response

        def on_response(connection: ServerConnection, request: Request, response: Response) -> None:
            if response.headers.get("Content-Type", "").startswith("text/html"):
                response.body = response.body.replace(b"<title>Viser</title>", b"<title>sarsplat view</title>")
                response.body = response.body.replace(b"</head>", addition + b"</head>", 1)
                response.headers.pop("Content-Length")
                response.headers["Content-Length"] = str(len(response.body))
                response.headers["Content-Security-Policy"] = _POLICY.format(sockets=f"ws://{request.headers['Host']}")
                response.headers["Referrer-Policy"] = "no-referrer"

        hooks: dict[str, Any] = {"process_request": on_request, "process_response": on_response}
        return real(handler, sock=listener, **hooks, **options)

    library.serve = serve  # type: ignore[misc, assignment]
    try:
        yield
    finally:
        library.serve = real  # type: ignore[misc]


def _rejection(request: Request) -> str | None:
    """Reason to reject a request to another host name or from another site's page, or None.

    Browsers send the origin with every socket; other programs send none.
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


# ---- drawing ---------------------------------------------------------------------------------------------------------
class Newest:
    """Thread that runs one function on request, never twice at once.

    Requests during a run lead to a single further run: the function reads the newest state itself. Errors are logged
    and do not stop the thread.
    """

    def __init__(self, work: Callable[[], object]) -> None:
        self._work = work
        self._pool = futures.ThreadPoolExecutor(1, "sarsplat-view")
        self._asking = threading.Lock()
        self._last: futures.Future[None] | None = None
        self._closed = False
        self.done = 0

    def ask(self) -> None:
        """Request the work; it starts as soon as the thread is free."""
        with self._asking:
            waiting = self._last is not None and not (self._last.running() or self._last.done())
            if not waiting and not self._closed:
                self._last = self._pool.submit(self._run)

    def wait(self, timeout_s: float) -> bool:
        """Wait until all requested work is done; False on timeout."""
        return self._last is None or not futures.wait([self._last], timeout_s).not_done

    def close(self) -> None:
        """Finish the work in progress and ignore later requests."""
        with self._asking:
            self._closed = True
        self._pool.shutdown(cancel_futures=True)

    def _run(self) -> None:
        try:
            self._work()
        except Exception:
            logging.getLogger("sarsplat").exception("the picture could not be drawn")
        self.done += 1
