"""The targets of the Makefile install what they need."""

import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


def installs(target: str, folder: Path) -> list[str]:
    """The arguments after `pip install` in the commands that a target would run in a fresh checkout."""
    for name in ("Makefile", "pyproject.toml"):
        shutil.copy(ROOT / name, folder)
    words = ["make", "--dry-run", "--no-print-directory", target]
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True, timeout=60, check=True)
    return [line.partition("pip install")[2] for line in done.stdout.splitlines() if "pip install" in line]


@pytest.mark.skipif(shutil.which("make") is None, reason="no make")
def test_the_demo_installs_no_extra_and_the_tests_install_all_of_them(tmp_path: Path) -> None:
    (demo,) = installs("demo", tmp_path)
    assert demo.endswith("--editable .")
    assert any("torch" in line and "dev" in line for line in installs("test", tmp_path))
