"""A headless Chromium over its DevTools protocol: enough to load a page, use it, look at it and watch the network."""

import base64
import itertools
import json
import shutil
import subprocess
import tempfile
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

_FLAGS = (
    "--headless",
    "--no-sandbox",
    "--use-angle=swiftshader",  # WebGL in software
    "--enable-unsafe-swiftshader",
    "--disable-background-networking",
    "--disable-component-update",
    "--no-first-run",
    "--remote-debugging-port=0",
)
_PATIENCE_S = 60.0  # for whatever a loaded machine may take long for
_OWN_ERRANDS = "not an origin"  # what Chromium calls the origin of requests that no page made


class Page:
    """One tab."""

    def __init__(self, address: str) -> None:
        from websockets.sync.client import connect

        self._socket = connect(address, max_size=None)
        self._numbers = itertools.count(1)
        self._events: list[dict[str, Any]] = []
        for domain in ("Page", "Runtime", "Log"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **parameters: Any) -> Any:
        """A command's result; events that come meanwhile are kept."""
        number = self.tell(method, **parameters)
        while True:
            message = json.loads(self._socket.recv(timeout=_PATIENCE_S))
            if message.get("id") == number:
                assert "error" not in message, message
                return message["result"]
            self._events.append(message)

    def tell(self, method: str, **parameters: Any) -> int:
        """Send a command, and do not wait."""
        number = next(self._numbers)
        self._socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
        return number

    def size(self, width: int, height: int) -> None:
        self.call(
            "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=width < 600
        )

    def scheme(self, name: str) -> None:
        """Prefer "light" or "dark"."""
        self.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": name}])

    def open(self, address: str) -> None:
        """Load a page with everything that it names."""
        self._events.clear()
        self.call("Page.navigate", url=address)
        self.until(f"document.readyState === 'complete' && location.href === {json.dumps(address)}")

    def value(self, expression: str) -> Any:
        """What a JavaScript expression is."""
        found = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in found, found["exceptionDetails"]
        return found["result"].get("value")

    def until(self, expression: str, wanted: Callable[[Any], bool] = bool, timeout_s: float = _PATIENCE_S) -> Any:
        """Wait for an expression to become what is wanted."""
        end = time.monotonic() + timeout_s
        while True:
            found = self.value(expression)
            if wanted(found):
                return found
            assert time.monotonic() < end, f"{expression} is still {found!r}"
            time.sleep(0.1)

    def mouse(self, kind: str, x: float, y: float) -> None:
        pressed = {"mousePressed": 1, "mouseMoved": 1, "mouseReleased": 0}[kind]
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=pressed, clickCount=1)

    def click(self, x: float, y: float) -> None:
        self.mouse("mousePressed", x, y)
        self.mouse("mouseReleased", x, y)

    def key(self, name: str) -> None:
        for kind in ("keyDown", "keyUp"):
            self.call("Input.dispatchKeyEvent", type=kind, key=name, code=name)

    def picture(self) -> bytes:
        """What the page looks like, as PNG."""
        return base64.b64decode(self.call("Page.captureScreenshot")["data"])

    @property
    def complaints(self) -> list[dict[str, Any]]:
        """Uncaught errors of the page, and what it wrote to the console or its log."""
        self.value("0")  # so that all events have come
        told = ("Runtime.exceptionThrown", "Runtime.consoleAPICalled", "Log.entryAdded")
        return [event["params"] for event in self._events if event["method"] in told]


class Browser:
    """A running Chromium, its only tab, and the file in which it notes what it asks the network for."""

    def __init__(self, process: subprocess.Popen[bytes], page: Page, net_log: Path) -> None:
        self._process, self.page, self._net_log = process, page, net_log

    def quit(self) -> list[str]:
        """End it; the addresses of all that its pages and their workers had asked for, sockets included, files not."""
        self.page.tell("Browser.close")  # so that it completes its log
        self._process.wait(_PATIENCE_S)
        events = json.loads(self._net_log.read_text(encoding="utf-8"))["events"]
        asked = [event["params"] for event in events if {"url", "initiator"} <= event.get("params", {}).keys()]
        return list(dict.fromkeys(request["url"] for request in asked if request["initiator"] != _OWN_ERRANDS))


@contextmanager
def chromium() -> Iterator[Browser]:
    """A browser of one's own; skips the test if there is none."""
    pytest.importorskip("websockets", reason="the browser is driven with websockets")
    program = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if program is None:
        pytest.skip("no Chromium was found")
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        net_log = Path(profile) / "net.json"
        words = [program, *_FLAGS, f"--user-data-dir={profile}", f"--log-net-log={net_log}", "about:blank"]
        process = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            port = _port(Path(profile) / "DevToolsActivePort")
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/json") as answer:
                tabs = [tab for tab in json.load(answer) if tab["type"] == "page"]
            yield Browser(process, Page(tabs[0]["webSocketDebuggerUrl"]), net_log)
        finally:
            process.terminate()
            process.wait(_PATIENCE_S)


def _port(file: Path) -> int:
    end = time.monotonic() + _PATIENCE_S
    while time.monotonic() < end:
        if file.is_file() and (lines := file.read_text().splitlines()):
            return int(lines[0])
        time.sleep(0.1)
    raise AssertionError("Chromium did not start")
