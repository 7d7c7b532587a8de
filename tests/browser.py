"""A headless Chromium for tests of pages, driven through its own debugging protocol.

Nothing is installed by this: `scripts/browser` is what fetches one where it can.
"""

from __future__ import annotations

import asyncio
import base64
import json
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tornado.websocket import WebSocketClientConnection, websocket_connect

NAMES = ("chromium", "chromium-headless-shell", "chromium-browser", "google-chrome")
WHY_SKIPPED = (
    "needs a Chromium: none in MODEHARVEST_BROWSER, in the cache or on the PATH; `scripts/browser` "
    "puts one into the cache"
)


def find_browser() -> str | None:
    """The Chromium to use: that of the environment, of the cache, or of the system."""
    named = os.environ.get("MODEHARVEST_BROWSER")
    if named:
        return named
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser()) / "modeharvest"
    cached = sorted(cache.glob("chromium-*/run"))
    return str(cached[-1]) if cached else next(filter(None, map(shutil.which, NAMES)), None)


class Tab:
    """A page that is open: what it did, and what it says when asked."""

    def __init__(self, connection: WebSocketClientConnection, loop: asyncio.AbstractEventLoop):
        self._connection, self._loop, self._count = connection, loop, 0
        self.messages: list[str] = []
        """Of the console and of exceptions nobody caught."""
        self.requests: list[str] = []
        """Addresses that were asked for, those of data and blobs left out."""

    def send(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Call a method of the protocol and wait for its answer."""
        return self._loop.run_until_complete(asyncio.wait_for(self._send(method, parameters), 60))

    async def _send(self, method: str, parameters: dict[str, Any]) -> dict[str, Any]:
        self._count += 1
        number = self._count
        await self._connection.write_message(
            json.dumps({"id": number, "method": method, "params": parameters})
        )
        while True:
            text = await self._connection.read_message()
            assert text is not None, "the browser is gone"
            message = json.loads(text)
            if message.get("id") == number:
                assert "error" not in message, f"{method}: {message['error']}"
                return dict(message["result"])
            self._note(message)

    def _note(self, message: dict[str, Any]) -> None:
        what, more = message.get("method"), message.get("params", {})
        if what == "Runtime.exceptionThrown":
            self.messages.append(json.dumps(more["exceptionDetails"]))
        elif what == "Runtime.consoleAPICalled":
            self.messages.append(json.dumps(more["args"]))
        elif what == "Log.entryAdded":
            self.messages.append(json.dumps(more["entry"]))
        elif what == "Network.requestWillBeSent":
            address = more["request"]["url"]
            if not address.startswith(("data:", "blob:")):
                self.requests.append(address)

    def open(self, page: Path, width: int = 1280, height: int = 900, dark: bool = False) -> None:
        """Show a page in a window of that size [CSS px]."""
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.send(f"{domain}.enable")
        self.resize(width, height)
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.send("Emulation.setEmulatedMedia", features=[scheme])
        self.send("Page.navigate", url=page.as_uri())
        self.run("new Promise(done => document.readyState === 'complete' ? done() "
                 ": addEventListener('load', done))")  # fmt: skip

    def resize(self, width: int, height: int) -> None:
        """Give the window another size [CSS px]."""
        self.send("Emulation.setDeviceMetricsOverride", width=width, height=height,
                  deviceScaleFactor=1, mobile=False)  # fmt: skip

    def run(self, script: str) -> Any:
        """The value of an expression in the page; of a promise what it brings."""
        found = self.send("Runtime.evaluate", expression=script, awaitPromise=True,
                          returnByValue=True, userGesture=True)  # fmt: skip
        assert "exceptionDetails" not in found, found["exceptionDetails"]
        return found["result"].get("value")

    def mouse(self, x: float, y: float, kind: str = "mouseMoved", **more: Any) -> None:
        """Move the mouse to a position in the window [CSS px], press or release its button."""
        self.send("Input.dispatchMouseEvent", type=kind, x=x, y=y, **more)

    def click(self, x: float, y: float) -> None:
        """Click at a position in the window [CSS px]."""
        self.mouse(x, y)
        for kind in ("mousePressed", "mouseReleased"):
            self.mouse(x, y, kind, button="left", clickCount=1)

    def press(self, key: str) -> None:
        """Press and release a key by its name in the DOM."""
        text = {"text": key} if len(key) == 1 else {}
        for kind in ("keyDown", "keyUp"):
            self.send("Input.dispatchKeyEvent", type=kind, key=key,
                      **(text if kind == "keyDown" else {}))  # fmt: skip

    def picture(self, path: Path, whole: bool = False) -> None:
        """Write what is seen, or the whole page, as PNG."""
        found = self.send("Page.captureScreenshot", captureBeyondViewport=whole)
        path.write_bytes(base64.b64decode(found["data"]))


@contextmanager
def browser(command: str, downloads: Path | None = None) -> Iterator[Tab]:
    """Start a browser with one empty page; files that it saves go to ``downloads``."""
    loop = asyncio.new_event_loop()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        options = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage",
                   "--remote-debugging-port=0", f"--user-data-dir={profile}",
                   "--no-first-run", "--disable-background-networking"]  # fmt: skip
        process = subprocess.Popen(
            [command, *options, "about:blank"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        try:
            port = _port(Path(profile, "DevToolsActivePort"), process)
            tab = Tab(loop.run_until_complete(_connected(port)), loop)
            if downloads is not None:
                tab.send("Browser.setDownloadBehavior", behavior="allow",
                         downloadPath=str(downloads))  # fmt: skip
            yield tab
            loop.run_until_complete(_closed(tab))
        finally:
            process.terminate()
            process.wait(30)
            loop.close()


def _port(file: Path, process: subprocess.Popen[bytes], seconds: float = 60.0) -> str:
    """The port that the browser listens on, once it has written it down."""
    for _ in range(int(10 * seconds)):
        if file.exists() and (text := file.read_text().split()):
            return text[0]
        assert process.poll() is None, f"the browser ended with {process.returncode}"
        time.sleep(0.1)
    raise TimeoutError("the browser didn't come up")


async def _closed(tab: Tab) -> None:
    tab._connection.close()
    while await tab._connection.read_message() is not None:
        pass


async def _connected(port: str) -> WebSocketClientConnection:
    from tornado.httpclient import AsyncHTTPClient

    found = await AsyncHTTPClient().fetch(f"http://127.0.0.1:{port}/json/list")
    pages = [page for page in json.loads(found.body) if page["type"] == "page"]
    return await websocket_connect(pages[0]["webSocketDebuggerUrl"], max_message_size=1 << 28)
