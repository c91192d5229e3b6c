"""Save the findings of a study as files: tracks and detections as MOTChallenge text, masks as PNG."""

from collections.abc import Sequence
from pathlib import Path

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.atomic_files import save_file
from torchvision_dddas.io.tables import MOT_TRACKS, mot_rows
from torchvision_dddas.lab.evaluation.studies.records import Findings, Results

KINDS = ("tracks", "detections", "masks")


def check_kinds(kinds: Sequence[str]) -> None:
    """Raise InputError for a kind that is not in KINDS."""
    if unknown := [kind for kind in kinds if kind not in KINDS]:
        raise InputError(f"--keep takes {', '.join(KINDS)}, got '{unknown[0]}'")


def keep_found(folder: Path, results: Results, kinds: Sequence[str]) -> list[str]:
    """Write FOLDER/TASK/CLIP/ with tracks.txt, detections.txt and masks/, as `dddas evaluate GT FOLDER/TASK` needs.

    Tracks are the boxes with an identity. Only labelled frames have masks. Return a note for each kind that no clip
    has. Raise InputError if the disk refuses.
    """
    written: set[str] = set()
    for case in results.cases:
        if (found := case.found) is None:
            continue
        place, has_tracks = folder / case.task / case.clip.name, bool((found.identity != -1).any())
        if "tracks" in kinds and has_tracks:
            save_file(place / "tracks.txt", _boxes(found, True))
        if "detections" in kinds and not has_tracks:
            save_file(place / "detections.txt", _boxes(found, False))
        for frame, mask in found.masks.items() if "masks" in kinds else ():
            save_file(place / "masks" / f"{frame:06d}.png", mask)
        written |= {"tracks" if has_tracks else "detections", *(["masks"] if found.masks else [])}
    return [f"--keep {kind}: no task of this study has {kind}" for kind in kinds if kind not in written]


def _boxes(found: Findings, named: bool) -> bytes:
    rows = found.identity != -1 if named else slice(None)
    boxes = mot_rows(0, found.box_px[rows], found.score[rows], found.identity[rows])
    return MOT_TRACKS.format_rows(boxes | {"frame": found.frame[rows]}).encode()
