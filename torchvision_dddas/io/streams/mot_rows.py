"""One frame as rows of MOTChallenge text."""

from dataclasses import replace

import numpy as np

from torchvision_dddas.io.output.tables import track_rows
from torchvision_dddas.io.tables import MOT_TRACKS
from torchvision_dddas.types import FrameResult, TrackedFrame

PEOPLE_FROM = 1_000_000
"""Added to the identities of people, who are followed apart from targets: the text has no column for a kind."""

_FARTHEST_PX = 1e7


def mot_rows(surveyed: FrameResult | None, people: TrackedFrame | None, most_bytes: int = 0) -> list[bytes]:
    """`frame,identity,x,y,width,height,score,-1,-1,-1`, a line a box that has an identity: targets, then people.

    One message a frame, or where that is longer than most_bytes several of whole lines. A box without end is no row.
    """
    text = "" if surveyed is None else MOT_TRACKS.format_rows(track_rows(_told(surveyed.followed, 0)))
    text += "" if people is None else MOT_TRACKS.format_rows(track_rows(_told(people, PEOPLE_FROM)))
    messages = [b""]
    for line in text.encode("ascii").splitlines(keepends=True):
        if messages[-1] and 0 < most_bytes < len(messages[-1]) + len(line):
            messages.append(b"")
        messages[-1] += line
    return [message for message in messages if message]


def _told(followed: TrackedFrame, more: int) -> TrackedFrame:
    tracks = followed.tracks
    told = np.isfinite(tracks.score) & (np.abs(tracks.box_px) < _FARTHEST_PX).all(axis=1)
    rows = replace(
        tracks,
        identity=tracks.identity[told] + more,
        box_px=tracks.box_px[told],
        score=tracks.score[told],
        row=tracks.row[told],
    )
    return replace(followed, tracks=rows)
