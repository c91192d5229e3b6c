"""Headless Chromium for tests: what a script finds in the dumped DOM of a page, and pages that a server sends."""

import base64
import html
import json
import os
import re
import select
import shutil
import subprocess
import time
from contextlib import suppress
from pathlib import Path
from typing import Any, Self

import cv2
import numpy as np
import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome")
CHROMIUM = next((path for name in NAMES if (path := shutil.which(name))), "")
FLAGS = ("--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage")
OFFLINE = "--host-resolver-rules=MAP * ~NOTFOUND"

needs_browser = pytest.mark.skipif(not CHROMIUM, reason="no Chromium on this machine: apt-get install chromium")

_HOST = """<!DOCTYPE html><meta charset="utf-8"><style>iframe{{width:{width}px;height:900px;border:0}}</style>
<iframe id="page" srcdoc="{page}"></iframe><pre id="result"></pre>
<script>addEventListener("load", function () {{
  var view = document.getElementById("page").contentWindow, page = view.document, result;
  try {{ result = (function (page, view) {{ {script} }})(page, view); }}
  catch (error) {{ result = "thrown: " + error; }}
  Promise.resolve(result).catch(String).then(function (kept) {{
    document.getElementById("result").textContent = JSON.stringify(kept); }});
}});</script>"""


def evaluate(page: str, script: str, folder: Path, width: int = 1280, dark: bool = False) -> Any:
    """Show a page in a frame of such a width and return what a script returns that has `page` and `view` (its window).

    The script may return a promise.

    folder: for the browser's files. dark: whether the user prefers dark pages.
    """
    assert CHROMIUM, "no Chromium on this machine"
    path = folder / "host.html"
    path.write_text(_HOST.format(width=width, page=html.escape(page), script=script), encoding="utf-8")
    scheme = f"--blink-settings=preferredColorScheme={0 if dark else 1}"
    command = [CHROMIUM, *FLAGS, OFFLINE, scheme, f"--user-data-dir={folder / 'profile'}", "--window-size=1400,1000"]
    command += ["--virtual-time-budget=10000", "--dump-dom", path.resolve().as_uri()]
    done = subprocess.run(command, capture_output=True, timeout=120, check=True)
    found = re.search(r'<pre id="result">(.*?)</pre>', done.stdout.decode(), re.DOTALL)
    assert found is not None, done.stdout[-500:]
    return json.loads(html.unescape(found[1]))


class Navigated(Exception):
    """The browser refused a call, as it does while a page is replaced."""


class Browser:
    """Chromium that opens served pages, driven by the DevTools protocol over pipes; used as a context.

    requested: the addresses that pages asked for. trouble: their errors and warnings, those of the policy too.
    """

    def __init__(self, folder: Path) -> None:
        """folder: for the browser's files."""
        assert CHROMIUM, "no Chromium on this machine"
        self.requested: list[str] = []
        self.trouble: list[str] = []
        self._session: str | None = None
        self._buffer, self._number = b"", 0
        ours_in, theirs_out = os.pipe()
        theirs_in, ours_out = os.pipe()
        flags = [*FLAGS, f"{OFFLINE}, EXCLUDE 127.0.0.1", f"--user-data-dir={folder / 'profile'}"]
        command = [CHROMIUM, *flags, "--hide-scrollbars", "--remote-debugging-pipe", "about:blank"]
        line = f'exec "$@" 3</dev/fd/{theirs_in} 4>/dev/fd/{theirs_out}'
        self._process = subprocess.Popen(
            ["sh", "-c", line, "sh", *command],
            pass_fds=(theirs_in, theirs_out),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(theirs_in)
        os.close(theirs_out)
        self._in, self._out = ours_in, ours_out

    def __enter__(self) -> Self:
        target = self._call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self._call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Network", "Log"):
            self._call(f"{domain}.enable")
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.wait(60)
        os.close(self._in)
        os.close(self._out)

    def open(self, url: str, width: int = 1280, height: int = 900, phone: bool = False) -> None:
        """Show a page in a window of a size in CSS pixels. phone: with touch, and two pixels a CSS pixel."""
        size = {"width": width, "height": height, "deviceScaleFactor": 2 if phone else 1, "mobile": phone}
        self._call("Emulation.setDeviceMetricsOverride", **size)
        self._call("Page.navigate", url=url)

    def evaluate(self, script: str) -> Any:
        """Return the value of an expression in the page, or of its promise."""
        answer = self._call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def wait(self, script: str, seconds: float = 60.0) -> Any:
        """Wait until an expression is true, and return its value. The page may load itself again meanwhile."""
        until_s = time.monotonic() + seconds
        while True:
            with suppress(Navigated):
                if found := self.evaluate(script):
                    return found
                text = self.evaluate("document.body?.innerText")
                assert time.monotonic() < until_s, f"{script} stays {found!r}; {text}"
            time.sleep(0.1)

    def picture(self) -> np.ndarray:
        """Return a screenshot, (H, W, 3) uint8 BGR."""
        png = base64.b64decode(self._call("Page.captureScreenshot")["data"])
        image = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
        assert image is not None
        return image

    def _call(self, method: str, **parameters: Any) -> Any:
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters}
        if self._session is not None:
            message["sessionId"] = self._session
        os.write(self._out, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._receive()
            if answer.get("id") == self._number:
                if "error" in answer:
                    raise Navigated(method, answer["error"])
                return answer["result"]
            self._note(answer.get("method"), answer.get("params", {}))

    def _receive(self) -> dict[str, Any]:
        while b"\0" not in self._buffer:
            assert select.select([self._in], [], [], 60.0)[0], "the browser does not answer"
            more = os.read(self._in, 1 << 20)
            assert more, "the browser has ended"
            self._buffer += more
        message, _, self._buffer = self._buffer.partition(b"\0")
        found: dict[str, Any] = json.loads(message)
        return found

    def _note(self, event: str | None, about: dict[str, Any]) -> None:
        if event == "Network.requestWillBeSent":
            self.requested.append(about["request"]["url"])
        elif event == "Log.entryAdded" and about["entry"]["level"] in ("error", "warning"):
            self.trouble.append("{text} {url}".format(**{"url": "", **about["entry"]}))
        elif event == "Runtime.exceptionThrown" or (
            event == "Runtime.consoleAPICalled" and about["type"] in ("error", "warning")
        ):
            self.trouble.append(json.dumps(about))
