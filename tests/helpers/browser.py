"""A headless Chromium, steered by its DevTools protocol over a WebSocket: no driver to install."""

from __future__ import annotations

import base64
import json
import os
import shutil
import subprocess
import tempfile
import time
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Self

from websockets.sync.client import ClientConnection, connect

__all__ = ["CHROMIUM", "Browser", "Page"]

CHROMIUM = os.environ.get("CHROMIUM") or shutil.which("chromium") or shutil.which("chromium-browser") or ""
FLAGS = (
    *(
        "--headless=new",
        "--no-sandbox",
        "--no-first-run",
        "--disable-gpu",
        "--disable-dev-shm-usage",
        "--hide-scrollbars",
    ),
    *("--remote-debugging-port=0", "--remote-allow-origins=*", "--disable-background-networking", "--mute-audio"),
    *("--disable-extensions", "--disable-component-update", "--disable-sync", "--no-default-browser-check"),
)
KEYS = {"Enter": ("Enter", 13, "\r"), "Escape": ("Escape", 27, ""), "Tab": ("Tab", 9, "")}


class Browser:
    """One process; `page` opens a tab. Ends with the `with` block."""

    def __init__(self) -> None:
        self._folder = tempfile.mkdtemp(prefix="browser-")
        environment = {**os.environ, "HOME": self._folder, "DBUS_SESSION_BUS_ADDRESS": "disabled:"}
        self._process = subprocess.Popen(
            [CHROMIUM, *FLAGS, f"--user-data-dir={self._folder}", "about:blank"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            stdin=subprocess.DEVNULL,
            env=environment,
        )
        self._sockets = ExitStack()

    def __enter__(self) -> Self:
        port = Path(self._folder) / "DevToolsActivePort"
        deadline = time.monotonic() + 40
        while not (port.exists() and len(lines := port.read_text().splitlines()) > 1):
            assert time.monotonic() < deadline, "Chromium does not start"
            assert self._process.poll() is None, "Chromium ended"
            time.sleep(0.02)
        self._base = f"ws://127.0.0.1:{lines[0]}"
        self._control = Page(self._joined(f"{self._base}{lines[1]}"), enable=False)
        return self

    def _joined(self, address: str) -> ClientConnection:
        return self._sockets.enter_context(connect(address, max_size=2**27, open_timeout=20))

    def page(self, url: str, width: int = 1280, height: int = 800, scheme: str = "light") -> Page:
        """A tab of this size with a memory of its own, on a system that is light or dark."""
        context = self._control.call("Target.createBrowserContext")["browserContextId"]
        where = {"url": "about:blank", "browserContextId": context}
        target = self._control.call("Target.createTarget", **where)["targetId"]
        page = Page(self._joined(f"{self._base}/devtools/page/{target}"))
        page.size(width, height)
        page.scheme(scheme)
        page.call("Page.navigate", url=url)
        return page

    def __exit__(self, *_: object) -> None:
        self._sockets.close()
        self._process.terminate()
        try:
            self._process.wait(10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        shutil.rmtree(self._folder, ignore_errors=True)


class Page:
    """A tab. complaints: what the page has said on its console of errors, exceptions and refused contents."""

    def __init__(self, socket: ClientConnection, enable: bool = True) -> None:
        self._socket = socket
        self._number = 0
        self.complaints: deque[str] = deque(maxlen=100)
        if enable:
            for domain in ("Page", "Runtime", "Log"):
                self.call(f"{domain}.enable")

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """A command of the protocol, and its result."""
        self._number += 1
        self._socket.send(json.dumps({"id": self._number, "method": method, "params": parameters}))
        while True:
            message: dict[str, Any] = json.loads(self._socket.recv(60))
            if message.get("id") == self._number:
                assert "error" not in message, (method, message["error"])
                result: dict[str, Any] = message["result"]
                return result
            self._note(message)

    def _note(self, message: dict[str, Any]) -> None:
        said = message.get("params", {})
        if message.get("method") == "Runtime.exceptionThrown":
            self.complaints.append(json.dumps(said["exceptionDetails"])[:600])
        elif message.get("method") == "Log.entryAdded" and said["entry"]["level"] == "error":
            self.complaints.append(f"{said['entry']['text']} {said['entry'].get('url', '')}")
        elif message.get("method") == "Runtime.consoleAPICalled" and said["type"] == "error":
            self.complaints.append(json.dumps(said["args"])[:600])

    def size(self, width: int, height: int, scale: float = 1.0) -> None:
        """The window, in px."""
        self.call(
            "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=scale, mobile=False
        )

    def scheme(self, scheme: str) -> None:
        """Whether the system is light or dark."""
        self.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])

    def js(self, expression: str) -> Any:
        """The value of an expression in the page, promises awaited."""
        found = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in found, found["exceptionDetails"]
        return found["result"].get("value")

    def text(self, selector: str) -> str:
        """What is read in the first node of this selector; "" where there is none."""
        return str(self.js(f"document.querySelector({json.dumps(selector)})?.innerText ?? ''"))

    def until(self, expression: str, timeout: float = 20.0) -> Any:
        """Wait until an expression of the page is true; its value."""
        return self.wait(
            lambda: self.js(f"(() => {{ try {{ return {expression} }} catch {{ return null }} }})()"), timeout
        )

    def wait(self, condition: Callable[[], Any], timeout: float = 20.0) -> Any:
        deadline = time.monotonic() + timeout
        while not (value := condition()):
            assert time.monotonic() < deadline, f"did not happen within {timeout} s; {list(self.complaints)}"
            time.sleep(0.02)
        return value

    def click(self, selector: str) -> None:
        """Click the middle of the first node of this selector."""
        place = self.js(
            f"(() => {{ const node = document.querySelector({json.dumps(selector)});"
            " node.scrollIntoView({block: 'center'});"
            " const box = node.getBoundingClientRect(); return [box.x + box.width / 2, box.y + box.height / 2]; })()"
        )
        self.click_at(*place)

    def click_at(self, x: float, y: float) -> None:
        for kind in ("mousePressed", "mouseReleased"):
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def type(self, text: str) -> None:
        """Write into what has the focus."""
        self.call("Input.insertText", text=text)

    def key(self, key: str) -> None:
        """Press a key."""
        name, code, text = KEYS.get(key, (key, ord(key.upper()) if len(key) == 1 else 0, key))
        given = {"key": name, "windowsVirtualKeyCode": code, **({"text": text} if text else {})}
        self.call("Input.dispatchKeyEvent", type="keyDown", **given)
        self.call("Input.dispatchKeyEvent", type="keyUp", key=name, windowsVirtualKeyCode=code)

    def shot(self, path: Path) -> None:
        """A picture of what is seen."""
        data = self.call("Page.captureScreenshot", format="png")["data"]
        path.write_bytes(base64.b64decode(data))
