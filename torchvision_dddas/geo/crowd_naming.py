"""The targets of followed frames under the names that they have on the ground."""

from dataclasses import replace

import numpy as np

from torchvision_dddas.geo.aerial_locator import Locator
from torchvision_dddas.tracking.crowd_identity import RollCall
from torchvision_dddas.types import Fix, TrackedFrame


def named(followed: TrackedFrame, fix: Fix, locator: Locator, roll: RollCall) -> TrackedFrame:
    """The frame with its targets under the names that roll gives them, without those that it gives none.

    Boxes that bridge a gap keep the name that they had.

    fix: how its picture lies on the ground. Feed it frames in order.
    """
    tracks = followed.tracks
    seen = np.flatnonzero(tracks.row >= 0)
    box = tracks.box_px[seen]
    middle = followed.detections.middle_px[tracks.row[seen]]
    middle = np.where(np.isfinite(middle), middle, box[:, :2] + (box[:, 2:] - 1) / 2)
    place, radius = locator.places(fix, middle), locator.radii(fix, box)
    identity = np.zeros(len(tracks), np.int64)
    identity[seen] = roll.step(locator.time_s(followed.number), tracks.identity[seen], place, radius)
    taken = set(identity[seen].tolist())
    for row in np.flatnonzero(tracks.row < 0).tolist():
        name = roll.name(int(tracks.identity[row]))
        if name not in taken:
            identity[row] = name
            taken.add(name)
    rows = np.flatnonzero(identity > 0)
    rows = rows[np.argsort(identity[rows], kind="stable")]
    kept = replace(
        tracks, identity=identity[rows], box_px=tracks.box_px[rows], score=tracks.score[rows], row=tracks.row[rows]
    )
    return replace(followed, tracks=kept)
