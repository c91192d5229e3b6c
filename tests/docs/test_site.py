"""The site is built without a warning and loads nothing from elsewhere; tutorials, quick starts and messages hold."""

import ast
import os
import re
import runpy
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import pytest

import torchvision_dddas
from tests.test_imports import ORDER

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
SCRIPTS = sorted((DOCS / "tutorials").glob("*.py"))
# Inputs that only a reader has.
OWN = ("clip.mp4", "camera:0", "rtsp://")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The built site, as `make docs` builds it: a warning is an error."""
    out = tmp_path_factory.mktemp("site")
    words = ["--builder", "html", "--fail-on-warning", "--keep-going", "--quiet", str(DOCS), str(out)]
    done = subprocess.run(
        [sys.executable, "-m", "sphinx", *words], cwd=ROOT, env=environ(), capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return out


def environ() -> dict[str, str]:
    """The environment of a user who has installed this checkout, without a screen."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    return {**os.environ, "PATH": path, "PYTHONPATH": str(ROOT), "MPLBACKEND": "agg"}


@pytest.mark.slow
def test_no_page_loads_anything_from_elsewhere(site: Path) -> None:
    pages = list(site.rglob("*.html"))
    assert len(pages) > 35
    loads = re.compile(r"""<(?:script|img|iframe|source|link)\b[^>]*\b(?:src|href)=["'](?:https?:)?//[^>]*>""")
    assert [found[0] for page in pages for found in loads.finditer(page.read_text(encoding="utf-8"))] == []
    styles = [path.read_text(encoding="utf-8") for path in site.rglob("*.css")]
    assert [
        found for style in styles for found in re.findall(r"(?:@import|url\()\s*['\"]?(?:https?:)?//.*", style)
    ] == []


@pytest.mark.slow
@pytest.mark.parametrize("module", ["", "functional", "nn"])
def test_every_public_name_is_in_the_reference(site: Path, module: str) -> None:
    pages = [site / "reference" / f"{name}.html" for name in ([module] if module else ["api", "records"])]
    page = "".join(page.read_text(encoding="utf-8") for page in pages)
    place = f"torchvision_dddas.{module}".rstrip(".")
    names = __import__(place, fromlist=["__all__"]).__all__
    kornia = {"oneway_transfer_error", "transform_points"}  # described by its own documentation
    assert [name for name in names if f'id="{place}.{name}"' not in page and name not in kornia] == []


@pytest.mark.slow
@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_a_tutorial_runs_and_makes_its_picture(script: Path, tmp_path: Path) -> None:
    variables = {**environ(), "XDG_CACHE_HOME": str(tmp_path / "cache")}
    done = subprocess.run([sys.executable, str(script)], cwd=tmp_path, env=variables, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    shown = re.findall(r"!\[[^\]]+\]\(([^)]+)\)", script.read_text(encoding="utf-8"))
    assert shown
    for name in shown:
        made, kept = (cv2.imread(str(folder / name)) for folder in (tmp_path, script.parent))
        assert made is not None and kept is not None and made.shape == kept.shape
        assert (script.parent / name).stat().st_size < 60_000


@pytest.mark.slow
@pytest.mark.parametrize("page", ["drone", "board", "datasets"])
def test_a_quick_start_can_be_followed(page: str, tmp_path: Path) -> None:
    variables = {**environ(), "XDG_CACHE_HOME": str(tmp_path / "cache")}
    text = (DOCS / "quickstart" / f"{page}.md").read_text(encoding="utf-8")
    for named, block in re.findall(r"`(\w+\.(?:toml|geojson))`[^`]*```(?:toml|json)\n(.*?)```", text, re.DOTALL):
        (tmp_path / named).write_text(block)
    lines = [line for block in re.findall(r"```sh\n(.*?)```", text, re.DOTALL) for line in block.splitlines()]
    lines = [line for line in lines if line.startswith("dddas ") and not any(word in line for word in OWN)]
    assert len(lines) >= 2
    for line in lines:
        done = subprocess.run(shlex.split(line), cwd=tmp_path, env=variables, capture_output=True, text=True)
        assert done.returncode == 0, f"{line}: {done.stderr}"
    for name in re.findall(r"`((?:found|zoned|default|fast|sweep)/[\w.]+)`", text):
        assert (tmp_path / name).exists()


def texts_of_code() -> Iterator[str]:
    """The texts in the package, with … for each value that is filled in."""
    for path in sorted(Path(torchvision_dddas.__file__).parent.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.JoinedStr):
                yield "".join(str(part.value) if isinstance(part, ast.Constant) else "…" for part in node.values)
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                yield node.value


@pytest.mark.slow
def test_the_messages_on_the_page_on_trouble_are_those_of_the_code() -> None:
    page = (DOCS / "troubleshooting.md").read_text(encoding="utf-8")
    messages = re.findall(r"^\| `([^`]+)` \|", page, re.MULTILINE)
    assert len(messages) >= 20
    code = "\n".join(texts_of_code())
    parts = {part.strip() for message in messages for part in message.split("…")}
    assert [part for part in parts if part not in code] == []


def test_the_drawing_of_the_rooms_is_that_of_their_order() -> None:
    draw = runpy.run_path(str(DOCS / "rooms.py"))["draw"]
    assert (DOCS / "rooms.svg").read_text(encoding="utf-8") == draw(ORDER)


def test_a_script_becomes_a_page_of_text_and_code() -> None:
    page = runpy.run_path(str(DOCS / "generated_pages.py"))["tutorial_page"]
    script = '"""# Title\n\nText.\n"""\n\nimport a\n\n# %%\n# More\n# text.\n\na.b()\n# why\n'
    assert page(script) == (
        "# Title\n\nText.\n\n```python\nimport a\n```\n\nMore\ntext.\n\n```python\na.b()\n# why\n```\n"
    )
