"""Chromium without a window, by its DevTools protocol: it needs nothing but websockets, of the extra `dev`."""

from __future__ import annotations

import base64
import itertools
import json
import os
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from websockets.sync.client import connect

CHROMIUM = Path(os.environ.get("CHROMIUM", "/usr/bin/chromium"))


class Browser:
    """Chromium without a window, by its DevTools protocol."""

    def __init__(self, folder: Path):
        words = [str(CHROMIUM), "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--hide-scrollbars"]
        words += ["--remote-debugging-port=0", f"--user-data-dir={folder}", "about:blank"]
        self._process = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        port = folder / "DevToolsActivePort"
        while not port.is_file() or len(port.read_text().splitlines()) < 2:
            if self._process.poll() is not None:
                raise SystemExit(f"{CHROMIUM} does not start")
            time.sleep(0.1)
        number, path = port.read_text().splitlines()[:2]
        self._wire = connect(f"ws://127.0.0.1:{number}{path}", max_size=None)
        self._numbers = itertools.count(1)

    def close(self) -> None:
        self._wire.close()
        self._process.kill()
        self._process.wait()

    def call(self, method: str, session: str = "", **parameters: object) -> dict:
        number = next(self._numbers)
        request = {"id": number, "method": method, "params": parameters}
        self._wire.send(json.dumps(request | ({"sessionId": session} if session else {})))
        while True:
            answer = json.loads(self._wire.recv())
            if answer.get("id") == number:
                return answer["result"]

    @contextmanager
    def page(self, url: str, width: int, height: int, scheme: str) -> Iterator[Page]:
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600}
        self.call("Emulation.setDeviceMetricsOverride", session, **metrics)
        page = Page(self, session)
        page.show(scheme)
        self.call("Page.navigate", session, url=url)
        while page.value("location.href === 'about:blank' || document.readyState !== 'complete'"):
            time.sleep(0.05)
        yield page
        self.call("Target.closeTarget", targetId=target)


class Page:
    """One page of the browser."""

    def __init__(self, browser: Browser, session: str):
        self._browser, self._session = browser, session

    def picture(self) -> bytes:
        """A PNG of the page."""
        return base64.b64decode(self._browser.call("Page.captureScreenshot", self._session, format="png")["data"])

    def show(self, scheme: str) -> None:
        """Prefer light or dark from now on."""
        media = [{"name": "prefers-color-scheme", "value": scheme}]
        self._browser.call("Emulation.setEmulatedMedia", self._session, features=media)

    def value(self, expression: str) -> object:
        """Value of a JavaScript expression."""
        found = self._browser.call("Runtime.evaluate", self._session, expression=expression, returnByValue=True)
        assert "exceptionDetails" not in found, found
        return found["result"].get("value")
