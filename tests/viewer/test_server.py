"""The server: this machine only, one port or none; and its thread, which works on the newest request only."""

import ast
import asyncio
import http.client
import logging
import re
import socket
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from sarsplat import SarsplatError, viewer
from sarsplat.viewer.server import Newest, _served_on, start_server, stop_server

pytest.importorskip("viser")

from websockets.asyncio import server as library


@pytest.fixture
def picked() -> list[tuple[float, float]]:
    return []


@pytest.fixture
def port(picked):
    server = start_server(0, lambda *place: picked.append(place))
    yield server.get_port()
    stop_server(server)


def ask(port: int, path: str, **headers: str) -> Any:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=30)
    connection.request("GET", path, headers={name.replace("_", "-"): value for name, value in headers.items()})
    answer: Any = connection.getresponse()
    answer.content = answer.read()
    connection.close()
    return answer


def test_the_page_may_load_nothing_from_elsewhere(port):
    answer = ask(port, "/", Accept_Encoding="gzip")
    assert answer.status == 200
    policy = answer.headers["Content-Security-Policy"]
    assert "default-src 'none'" in policy and f"ws://127.0.0.1:{port}" in policy
    assert not [word for word in policy.replace(";", "").split() if word.startswith("http") or word == "*"]
    assert b"sarsplat view</title>" in answer.content and b"/pick?" in answer.content
    assert len(answer.content) == int(answer.headers["Content-Length"])


def test_a_click_is_reported_as_parts_of_the_picture_and_what_is_none_is_refused(port, picked):
    assert ask(port, "/pick?x=0.25&y=0.5").status == 204
    for words in ("", "?x=1", "?x=a&y=0", "?x=1.5&y=0.5", "?x=nan&y=0.5"):
        assert ask(port, f"/pick{words}").status == 400
    assert ask(port, "/pick?x=0.25&y=0.5", Sec_Fetch_Site="cross-site").status == 400
    assert picked == [(0.25, 0.5)]


def raw(port: int, *lines: str) -> bytes:
    """The status line of the answer to a request as it goes over the wire."""
    with socket.create_connection(("127.0.0.1", port), timeout=30) as plug:
        plug.sendall("\r\n".join([*lines, "", ""]).encode("latin-1"))
        return plug.recv(200).partition(b"\r\n")[0]


SOCKET = ("Upgrade: websocket", "Connection: Upgrade", "Sec-WebSocket-Version: 13")
SOCKET += ("Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==", "Sec-WebSocket-Protocol: viser-v1.1.1")


@pytest.mark.parametrize("kind", ["page", "pick", "socket"])
@pytest.mark.parametrize(
    "host",
    [
        *("evil.example:{port}", "127.0.0.1.evil.example:{port}", "localhost.evil.example", "192.168.0.7", ""),
        *("localhost.:{port}", "127.0.0.1:{port}@evil.example", "0.0.0.0:{port}", "[::2]:{port}", "localhost:port"),
    ],
)
def test_a_name_that_is_not_this_machines_is_not_answered(port, picked, host, kind):
    """A stranger's name that was made to mean 127.0.0.1, so that the browser takes its page and ours for one site."""
    host = host.format(port=port)
    path = {"page": "/", "pick": "/pick?x=0.25&y=0.5", "socket": "/"}[kind]
    lines = [f"GET {path} HTTP/1.1", f"Host: {host}", f"Origin: http://{host}", *(SOCKET if kind == "socket" else ())]
    assert raw(port, *lines).startswith(b"HTTP/1.1 403")
    assert picked == []


def test_requests_without_a_name_or_with_two_are_not_answered(port):
    for hosts in ([], [f"Host: localhost:{port}", "Host: evil.example"]):
        assert raw(port, "GET / HTTP/1.1", *hosts).startswith((b"HTTP/1.1 403", b"HTTP/1.1 400"))


@pytest.mark.parametrize("name", ["127.0.0.1", "localhost", "LOCALHOST", "[::1]"])
@pytest.mark.parametrize("other_port", [None, 9000])
def test_pages_and_sockets_of_this_machine_are_answered_also_through_a_tunnel(port, name, other_port):
    """`ssh -L 9000:localhost:8765` shows the page at another port."""
    host = f"{name}:{other_port or port}"
    assert raw(port, "GET / HTTP/1.1", f"Host: {host}").startswith(b"HTTP/1.1 200")
    for origin in ([f"Origin: http://{host}"], []):  # of a browser, and of another program
        assert raw(port, "GET / HTTP/1.1", f"Host: {host}", *SOCKET, *origin).startswith(b"HTTP/1.1 101")
    policy = ask(port, "/", Host=host).headers["Content-Security-Policy"]
    assert f"connect-src 'self' ws://{host} " in policy


@pytest.mark.parametrize(
    "origin",
    ["https://evil.example", "null", "http://evil.example:{port}", "http://localhost", "http://127.0.0.1:{port}"],
)
def test_pages_of_other_sites_open_no_socket_and_click_nothing(port, picked, origin):
    """Nor those of another program on this machine, which another port or name tells apart."""
    lines = [f"Host: localhost:{port}", f"Origin: {origin.format(port=port)}"]
    assert raw(port, "GET / HTTP/1.1", *lines, *SOCKET).startswith(b"HTTP/1.1 403")
    assert raw(port, "GET /pick?x=0.25&y=0.5 HTTP/1.1", *lines).startswith(b"HTTP/1.1 403")
    assert picked == []


def test_no_other_machine_can_connect(port):
    with socket.socket(socket.AF_INET) as probe:  # every other address of this machine is another interface
        assert probe.connect_ex(("127.0.0.2", port)) != 0


def test_a_port_in_use_is_refused_and_not_replaced_by_the_next(port):
    with pytest.raises(SarsplatError, match=rf"^port {port} of this machine cannot be used \(.*\); choose another"):
        start_server(port, lambda *place: None)
    for none in (-1, 65536):
        with pytest.raises(SarsplatError, match=f"port {none} is not a valid port"):
            start_server(none, lambda *place: None)


def test_another_server_that_starts_meanwhile_is_left_alone():
    async def other() -> int:
        async with library.serve(lambda connection: None, "127.0.0.1", 0) as started:
            return started.sockets[0].getsockname()[1]

    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
        with _served_on(listener, port, lambda *place: None):
            assert asyncio.run(other()) != port
    assert library.serve.__module__ == "websockets.asyncio.server"  # nothing of it stays changed


def test_pages_that_start_at_once_are_all_protected():
    with ThreadPoolExecutor(4) as pool:
        servers = list(pool.map(lambda _: start_server(0, lambda *place: None), range(4)))
    ports = {server.get_port() for server in servers}
    policies = [ask(port, "/").headers["Content-Security-Policy"] for port in ports]
    for server in servers:
        stop_server(server)
    assert len(policies) == 4 and all("default-src 'none'" in policy for policy in policies)


def test_the_viewer_uses_no_private_part_of_another_package():
    for path in Path(viewer.__file__).parent.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Attribute) and re.match(r"_[a-z]", node.attr):
                assert isinstance(node.value, ast.Name) and node.value.id in ("self", "cls"), f"{path}:{node.lineno}"


def test_many_requests_during_one_piece_of_work_are_one_more():
    begun, go_on, seen, state = threading.Event(), threading.Event(), [], [0]

    def work() -> None:
        begun.set()
        go_on.wait(10)
        seen.append(state[0])

    newest = Newest(work)
    newest.ask()
    assert begun.wait(10)
    for k in range(1, 51):
        state[0] = k
        newest.ask()
    assert not newest.wait(0.01)
    go_on.set()
    assert newest.wait(10)
    newest.close()
    assert seen == [50, 50]


def test_an_error_is_logged_and_the_next_request_is_served(caplog):
    done = []

    def work() -> None:
        done.append(1)
        if len(done) == 1:
            raise ValueError("no picture")

    newest = Newest(work)
    with caplog.at_level(logging.ERROR, "sarsplat"):
        for _ in range(2):
            newest.ask()
            assert newest.wait(10)
    newest.close()
    assert len(done) == 2
    assert "no picture" in caplog.text
