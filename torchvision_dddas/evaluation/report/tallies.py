"""What is right, false and missed in each frame, whichever group of counts tells it."""

from typing import NamedTuple

import numpy as np

from torchvision_dddas.evaluation.studies.results import Scored

_GROUPS = ("pixels", "tracks", "boxes", "target_track", "target", "still")
_NAMES = {"right": ("tp", "hit", "found"), "false": ("fp", "false", "blobs"), "missed": ("fn", "missed")}


class Tally(NamedTuple):
    """Of each frame (F,): what is right, false, missed, changed identity, and the rest (of pixels) that is right too.

    unit: what is counted. measure: what 2 right / (2 right + false + missed) is called.
    """

    right: np.ndarray
    false: np.ndarray
    missed: np.ndarray
    switched: np.ndarray
    rest: np.ndarray
    unit: str
    measure: str


def main_group(scored: Scored) -> str | None:
    """The group that tells most of where a clip goes wrong."""
    return next((group for group in _GROUPS if group in scored.per_frame), None)


def tally(scored: Scored, group: str) -> Tally:
    """The counts of each frame; 0 where a group has no use for the frame."""
    mine = scored.per_frame[group]

    def of(*names: str) -> np.ndarray:
        known = [np.nan_to_num(np.asarray(mine[name], float)) for name in names if name in mine]
        return known[0] if known else np.zeros(len(scored.frames))

    right, false, missed = (of(*names) for names in _NAMES.values())
    if group in ("target", "target_track"):  # in a frame with the target it is found or missed
        missed = np.maximum(of("frames") - right, 0)
    rest, unit = (of("tn"), "pixels") if group == "pixels" else (np.zeros(len(right)), "boxes")
    measure = "F" if group == "pixels" else "hit" if group in ("target", "target_track") else "F1"
    return Tally(right, false, missed, of("switches"), rest, unit, measure)
