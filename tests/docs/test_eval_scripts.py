"""Every script in eval/ explains itself without data."""

import contextlib
import io
import re
import runpy
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
OTHER_ENVIRONMENTS = ("run_norfair.py", "run_trackers.py", "trackeval_figures.py")
SCRIPTS = sorted(
    path.relative_to(ROOT).as_posix()
    for path in (ROOT / "eval").rglob("*.py")
    if "__main__" in path.read_text(encoding="utf-8") and path.name not in OTHER_ENVIRONMENTS
)


def help_of(script: str, *words: str) -> str:
    """What a script prints for --help."""
    modules, path, argv = set(sys.modules), list(sys.path), sys.argv
    sys.path.insert(0, str((ROOT / script).parent))
    sys.argv = [script, *words, "--help"]
    printed = io.StringIO()
    try:
        with contextlib.redirect_stdout(printed), pytest.raises(SystemExit) as ended:
            runpy.run_path(str(ROOT / script), run_name="__main__")
    finally:
        sys.path[:], sys.argv = path, argv
        for name in set(sys.modules) - modules:  # modules beside the script must not shadow others later
            if str(getattr(sys.modules[name], "__file__", "")).startswith(str(ROOT / "eval")):
                del sys.modules[name]
    assert ended.value.code == 0
    return printed.getvalue()


@pytest.mark.slow
@pytest.mark.parametrize("script", SCRIPTS)
def test_a_script_and_its_studies_explain_themselves_without_data(script: str) -> None:
    told = help_of(script)
    assert "usage:" in told
    for study in re.findall(r'^        "([\w-]+)": \(', (ROOT / script).read_text(encoding="utf-8"), re.M):
        if re.search(rf"^    {study} ", told, re.M):
            assert "--write" in help_of(script, study)


def test_there_are_studies() -> None:
    assert len(SCRIPTS) >= 12
    assert all(
        f"eval/{name}" in (ROOT / "eval/README.md").read_text() for name in ("accuracy.py", "speed.py", "live.py")
    )
