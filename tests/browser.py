"""Headless Chromium for tests: what a script finds in a page, read from the dumped DOM."""

import html
import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

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
