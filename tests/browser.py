"""Headless Chromium through the Chrome DevTools protocol, spoken over the websocket client that viser needs anyway."""

import base64
import io
import itertools
import json
import shutil
import subprocess
import time
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))), None)
FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-dev-shm-usage",
    "--disable-extensions",
    "--disable-background-networking",
    "--mute-audio",
    "--no-first-run",
    "--remote-debugging-port=0",
)
PATIENCE = 120.0  #: seconds until what is waited for counts as never coming


def wait_for(condition: Callable[[], Any], what: str, patience: float = PATIENCE) -> Any:
    """What `condition` returns once it is true; AssertionError after `patience` seconds."""
    deadline = time.monotonic() + patience
    while True:
        found = condition()
        if found:
            return found
        assert time.monotonic() < deadline, f"waited {patience:.0f} s for {what}"
        time.sleep(0.05)


class Browser:
    """A Chromium of its own; `Page`s are its tabs."""

    def __init__(self, folder: Path) -> None:
        assert CHROMIUM is not None
        self._process = subprocess.Popen(
            [CHROMIUM, *FLAGS, f"--user-data-dir={folder}", "about:blank"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        port_file = folder / "DevToolsActivePort"
        lines = wait_for(lambda: port_file.exists() and port_file.read_text().splitlines(), "Chromium")
        self._port = int(lines[0])

    def open(self, url: str, width: int = 640, height: int = 480) -> "Page":
        """A new tab."""
        request = urllib.request.Request(f"http://127.0.0.1:{self._port}/json/new?about:blank", method="PUT")
        with urllib.request.urlopen(request, timeout=PATIENCE) as answer:
            page = Page(json.load(answer)["webSocketDebuggerUrl"])
        page.send("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)
        page.send("Page.navigate", url=url)
        return page

    def close(self) -> None:
        """End it."""
        self._process.terminate()
        try:
            self._process.wait(10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


class Page:
    """A tab."""

    def __init__(self, url: str) -> None:
        from websockets.sync.client import connect

        self._socket = connect(url, max_size=None, open_timeout=PATIENCE)
        self._number = itertools.count(1)

    def send(self, method: str, **parameters: Any) -> dict[str, Any]:
        """The result of a command of the protocol."""
        number = next(self._number)
        self._socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while True:
            message = json.loads(self._socket.recv(timeout=PATIENCE))
            if message.get("id") == number:
                assert "error" not in message, message
                return message["result"]

    def evaluate(self, expression: str) -> Any:
        """The value of a JavaScript expression."""
        result = self.send("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in result, result
        return result["result"].get("value")

    def text(self) -> str:
        """All that can be read on the page."""
        return self.evaluate("document.body ? document.body.innerText : ''") or ""

    def picture(self) -> np.ndarray:
        """[H, W, 3] uint8: what the tab shows."""
        data = base64.b64decode(self.send("Page.captureScreenshot", format="png")["data"])
        return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))

    def frames(self, count: int = 2) -> None:
        """Wait until the tab, in front of others, has drawn so often, however slow; 2 s where it draws nothing."""
        self.send("Page.bringToFront")  # others draw nothing
        watch = "clearTimeout(end); end = setTimeout(done, 2000);"
        step = f"const step = () => {{ {watch} count-- ? requestAnimationFrame(step) : done(); }};"
        self.evaluate(f"new Promise(done => {{ let count = {count}, end; {step} step(); }})")

    def mouse(self, kind: str, x: float, y: float, buttons: int = 0) -> None:
        """One event of the mouse: mousePressed, mouseMoved or mouseReleased."""
        pressed = {} if kind == "mouseMoved" else {"button": "left", "clickCount": 1}
        self.send("Input.dispatchMouseEvent", type=kind, x=x, y=y, buttons=buttons, **pressed)

    def drag(self, start: tuple[float, float], end: tuple[float, float], steps: int = 8) -> None:
        """With the left button from one point to another, pixels."""
        self.mouse("mouseMoved", *start)
        self.frames(8)  # what is under the pointer is found out in the next frames
        self.mouse("mousePressed", *start, buttons=1)
        for k in range(1, steps + 1):
            share = k / steps
            point = [(1 - share) * a + share * b for a, b in zip(start, end, strict=True)]
            self.mouse("mouseMoved", *point, buttons=1)
            self.frames(3)
        self.mouse("mouseReleased", *end)

    def click(self, x: float, y: float) -> None:
        """With the left button."""
        self.mouse("mouseMoved", x, y)
        self.frames(8)
        self.mouse("mousePressed", x, y, buttons=1)
        self.mouse("mouseReleased", x, y)

    def close(self) -> None:
        """Close the connection to the tab, and the tab."""
        try:
            self.send("Page.close")
        finally:
            self._socket.close()


def fill(page: Page, uuid: str, value: str) -> None:
    """Type into the field of a control of viser, by its number, once it is shown: a folder that opens takes a while."""
    focus = f"""(() => {{
        let row = document.getElementById({uuid!r}) || document.querySelector("label[for='{uuid}']");
        if (!row) return false;
        const visible = "input:not([type=hidden])";
        while (!row.matches(visible) && !row.querySelector(visible)) row = row.parentElement;
        const field = row.matches(visible) ? row : row.querySelector(visible);
        field.scrollIntoView(); field.focus(); field.select(); return document.activeElement == field; }})()"""
    wait_for(lambda: page.evaluate(focus), "the field")
    page.send("Input.insertText", text=value)
    for kind in ("keyDown", "keyUp"):
        page.send("Input.dispatchKeyEvent", type=kind, key="Enter", code="Enter", windowsVirtualKeyCode=13)
    page.evaluate("document.activeElement.blur()")


def choose(page: Page, uuid: str, option: str) -> None:
    """Choose in a dropdown of viser, by its number."""
    page.evaluate(f"(() => {{ const one = document.getElementById({uuid!r}); one.focus(); one.click(); }})()")
    text = f"""[...document.querySelectorAll("[role=option]")].find(one => one.innerText.trim() == {option!r})"""
    wait_for(lambda: page.evaluate(f"(() => {{ const o = {text}; if (o) o.click(); return !!o; }})()"), option)


def press(page: Page, words: str) -> None:
    """Click the button, or open the folder, that says so."""
    found = page.evaluate(
        f"""(() => {{
            const all = [...document.querySelectorAll("button, p, div, span")];
            const one = all.findLast(one => one.innerText && one.innerText.trim() == {words!r});
            if (one) {{ one.scrollIntoView(); one.click(); }} return !!one; }})()"""
    )
    assert found, words
