"""A headless Chromium for tests of pages: what they show, what they ask for, and what goes wrong in them."""

import base64
import json
import os
import select
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")


class Browser:
    """A headless Chromium, driven by its DevTools protocol through two pipes."""

    def __init__(self, program: str) -> None:
        self.profile = tempfile.TemporaryDirectory(prefix="limsim-jax-viewer-", ignore_cleanup_errors=True)
        from_us, self.to = os.pipe()
        self.come, from_it = os.pipe()
        # the browser reads its commands from descriptor 3 and answers on 4
        start = (
            "import os, sys; r, w = (os.dup(int(x)) for x in sys.argv[1:3]); os.dup2(r, 3); os.dup2(w, 4);"
            "[os.set_inheritable(x, True) for x in (3, 4)]; os.execvp(sys.argv[3], sys.argv[3:])"
        )
        options = ["--headless=new", "--no-sandbox", "--disable-gpu", "--remote-debugging-pipe",
                   "--no-first-run", "--disable-dev-shm-usage", "--hide-scrollbars", "--mute-audio",
                   "--disable-background-networking", f"--user-data-dir={self.profile.name}"]  # fmt: skip
        self.process = subprocess.Popen(
            [sys.executable, "-c", start, str(from_us), str(from_it), program, *options],
            pass_fds=(from_us, from_it),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(from_us)
        os.close(from_it)
        self.rest, self.number, self.events = b"", 0, []
        self.session: str | None = None
        target = self.send("Target.createTarget", url="about:blank")["targetId"]
        self.session = self.send("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.send(f"{domain}.enable")

    def send(self, method: str, **parameters: Any) -> Any:
        """Send a command and return its result; what else comes in goes to `events`."""
        self.number += 1
        message = {"id": self.number, "method": method, "params": parameters}
        if self.session is not None:
            message["sessionId"] = self.session
        os.write(self.to, json.dumps(message).encode() + b"\0")
        until = time.monotonic() + 60
        while True:
            while b"\0" not in self.rest:
                if not select.select([self.come], [], [], max(0, until - time.monotonic()))[0]:
                    raise TimeoutError(f"no answer to {method}")
                more = os.read(self.come, 1 << 20)
                if not more:
                    raise RuntimeError("the browser has ended")
                self.rest += more
            line, _, self.rest = self.rest.partition(b"\0")
            answer = json.loads(line)
            if answer.get("id") == self.number:
                if "error" in answer:
                    raise RuntimeError(f"{method}: {answer['error']}")
                return answer["result"]
            self.events.append(answer)

    def run(self, script: str) -> Any:
        """The value of an expression of JavaScript, awaited."""
        done = self.send("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in done, done["exceptionDetails"]
        return done["result"].get("value")

    def open(
        self, path: Path, fragment: str = "", *, size: tuple[int, int] = (1280, 800), dark: bool = False
    ) -> dict[str, str]:
        """Load a page from disk and wait for its first frame; returns what it says about itself."""
        self.events.clear()
        self.send(
            "Emulation.setDeviceMetricsOverride",
            width=size[0],
            height=size[1],
            deviceScaleFactor=1,
            mobile=False,
        )
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.send("Emulation.setEmulatedMedia", features=[scheme])
        self.send("Page.navigate", url="about:blank")
        self.send("Page.navigate", url=path.as_uri() + fragment)
        self.run("""new Promise(done => { const look = () => {
            const data = document.body && document.body.dataset;
            data && (data.ready || data.error) ? done() : setTimeout(look, 20); }; look(); })""")
        return self.state()

    def state(self) -> dict[str, str]:
        """The data attributes of the page after the next frame."""
        frame = "requestAnimationFrame(() => requestAnimationFrame(() => done({...document.body.dataset})))"
        return self.run(f"new Promise(done => {frame})")

    def fact(self, name: str) -> float:
        return float(self.run(f"document.querySelector('[data-field={name}]').dataset.value || 'NaN'"))

    def text(self, selector: str) -> str:
        return self.run(f"document.querySelector({json.dumps(selector)}).textContent")

    def middle(self, selector: str) -> tuple[float, float]:
        script = (
            f"(b => [b.x + b.width / 2, b.y + b.height / 2])(document.querySelector({json.dumps(selector)})"
        )
        return tuple(self.run(f"{script}.getBoundingClientRect())"))

    def mouse(self, kind: str, x: float, y: float, **more: Any) -> None:
        self.send("Input.dispatchMouseEvent", type=kind, x=x, y=y, **more)

    def click(self, x: float, y: float) -> dict[str, str]:
        for kind in ("mousePressed", "mouseReleased"):
            self.mouse(kind, x, y, button="left", buttons=1, clickCount=1)
        return self.state()

    def key(self, key: str, code: str = "", **more: Any) -> dict[str, str]:
        for kind in ("keyDown", "keyUp"):
            self.send("Input.dispatchKeyEvent", type=kind, key=key, code=code or key, **more)
        return self.state()

    def picture(self, path: Path) -> None:
        path.write_bytes(base64.b64decode(self.send("Page.captureScreenshot", format="png")["data"]))

    def close(self) -> None:
        try:
            self.session = None
            self.send("Browser.close")
        except (OSError, RuntimeError, TimeoutError):
            self.process.kill()
        os.close(self.to)
        os.close(self.come)
        self.process.wait(30)
        self.profile.cleanup()


def chromium() -> Iterator[Browser]:
    """A browser for a fixture; skips the test where none is installed."""
    program = next(filter(None, map(shutil.which, BROWSERS)), None)
    if program is None:
        pytest.skip(f"none of {', '.join(BROWSERS)} is installed")
    browser = Browser(program)
    yield browser
    browser.close()


def problems(browser: Browser) -> list[Any]:
    """Errors of the page, and everything that it asked of a network."""
    bad = [
        event
        for event in browser.events
        if event.get("method") in ("Runtime.exceptionThrown", "Log.entryAdded")
    ]
    asked = [event["params"]["request"]["url"] for event in browser.events
             if event.get("method") == "Network.requestWillBeSent"]  # fmt: skip
    return bad + [url for url in asked if not url.startswith(("file:", "about:"))]


def centre(state: dict[str, str], slot: int) -> tuple[float, float]:
    """Where a vehicle is on the canvas."""
    places = dict(
        (int(i), (float(x), float(y))) for i, x, y in (v.split(",") for v in state["vehicles"].split())
    )
    return places[slot]


def on_screen(browser: Browser, at: tuple[float, float]) -> tuple[float, float]:
    x, y = browser.run("(b => [b.x, b.y])(document.getElementById('view').getBoundingClientRect())")
    return x + at[0], y + at[1]


def pixel(browser: Browser, x: float, y: float) -> tuple[int, ...]:
    script = f"[...document.getElementById('view').getContext('2d').getImageData({x}, {y}, 1, 1).data]"
    return tuple(browser.run(script)[:3])


def rgb(color: str) -> tuple[int, ...]:
    return tuple(int(color[i : i + 2], 16) for i in (1, 3, 5))


def near(color: tuple[int, ...], other: str) -> bool:
    return max(abs(a - b) for a, b in zip(color, rgb(other), strict=True)) < 60
