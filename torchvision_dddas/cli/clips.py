"""What commands say of the clips that they are given: folders named for them, facts for run.json, lines at the end."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torchvision_dddas.io.output import RunRecord
    from torchvision_dddas.types import Source


def folders_for(inputs: Sequence[str], out: Path) -> list[Path]:
    """Where the results of each input go: out itself, or for several a folder each in it."""
    return [out] if len(inputs) == 1 else [out / name for name in clip_names(inputs)]


def clip_names(inputs: Sequence[str]) -> list[str]:
    """A folder name for each input, no two alike: its own name, or its parent's where that says more than `frames`."""
    names: list[str] = []
    for clip in inputs:
        path = Path(clip.rstrip("/"))
        dull = [p.name in ("", "frames", "images") or bool(re.search(r"[*?\[]", p.name)) for p in (path, *path.parents)]
        named = path if all(dull) else (path, *path.parents)[dull.index(False)]
        name = named.stem if named == path and not path.is_dir() else named.name
        name = same = re.sub(r"[^\w.-]+", "-", name).strip("-.") or "clip"
        for k in range(2, len(inputs) + 1):
            if same not in names:
                break
            same = f"{name}-{k}"
        names.append(same)
    return names


def clip_facts(source: "Source") -> dict[str, Any]:
    """What run.json says of a clip."""
    return {
        "name": source.name,
        "size": source.size,
        "rate_hz": source.rate_hz,
        "announced_frames": source.count,
    }


def last_lines(
    first: str, journal: "RunRecord", folder: Path, made: Sequence[str], notes: Sequence[str] = ()
) -> list[str]:
    """What to tell the user at the end: the counts, what reading got over, notes, and what was made where."""
    lines = [first]
    if count := len(journal.problems):
        lines.append(
            f"{count} problem{'s' * (count != 1)} while reading, the first: {journal.problems[0]} (all in run.json)"
        )
    return [*lines, *(f"note: {note}" for note in notes), f"{folder}: {', '.join(made)}"]
