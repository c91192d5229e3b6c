"""Whether a table of detections goes with its clip and its interval: what is wrong, and what the user should know."""

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.source import Source
from torchvision_dddas.types import DetectionTable, is_sampled


def agreed(table: DetectionTable, interval: int, source: Source | None = None) -> list[str]:
    """Notes, each one sentence without a full stop, on rows that are left out or taken otherwise than they may look.

    Raises InputError before any work: frames after the end of a clip whose length is known, rows none of which lies on
    a frame that is looked at.
    """
    name = f"detections {table.path}"
    if len(table) == 0:
        return [f"{name} holds no rows"]
    if source is not None:
        within_clip(table, source)
    notes = []
    left_out = len(table) - int(is_sampled(table.frame, interval).sum())
    if left_out == len(table):
        looks = ", ".join(str(1 + k * interval) for k in range(3))
        raise InputError(
            f"{name} has no row on frames {looks}, ..., at which --interval {interval} looks; its first is on frame "
            f"{table.first}: number the frames so that one of them is 1, or take --interval 1"
        )
    if left_out:
        notes.append(f"{left_out} of {len(table)} rows lie on frames that --interval {interval} leaves out")
    elif (grid := _grid(table)) > interval:
        notes.append(
            f"rows lie on every {grid}th frame only, and the frames between count as misses: --interval {grid} says "
            "that nobody looked there"
        )
    if table.own:
        notes.append("all rows are moving targets of dddas detect: every row counts as certain")
    elif not table.probable:
        low, high = table.score.min(), table.score.max()
        notes.append(f"scores from {low:g} to {high:g} are no probabilities: every row counts as certain")
    if source is not None and (outside := int(_outside(table, source.size).sum())):
        notes.append(f"{outside} boxes lie wholly outside the picture; they are tracked like the others")
    return notes


def within_clip(table: DetectionTable, source: Source) -> None:
    """Raises InputError for a table that goes on after the end of a clip whose length is known."""
    if source.exact and source.count is not None and table.last > source.count:
        beyond = int((table.frame > source.count).sum())
        line = int(table.line[table.frame > source.count].min())
        raise InputError(
            f"detections {table.path}, line {line}: the table goes on to frame {table.last} but {source.name} ends "
            f"after frame {source.count} ({beyond} of {len(table)} rows lie beyond); is it the table of this clip?"
        )


def beginning(table: DetectionTable, birth_score: float) -> list[str]:
    """A note where no row's score is enough for a track to begin."""
    if not len(table) or table.certain or float(table.score.max()) >= birth_score:
        return []
    return [
        (
            f"no score of {table.path} reaches track.birth_score = {birth_score:g}, so no track begins: lower it with "
            "--set, or give the detections.csv if dddas detect wrote them"
        )
    ]


def _grid(table: DetectionTable) -> int:
    """The widest interval whose frames hold all rows; 1 where two frames are too few to tell."""
    frames = np.unique(table.frame)
    return int(np.gcd.reduce(frames - 1)) if len(frames) > 2 else 1


def _outside(table: DetectionTable, size: tuple[int, int]) -> np.ndarray:
    low, high = table.box_px[:, :2], table.box_px[:, :2] + table.box_px[:, 2:]
    return ((high <= 0) | (low >= size)).any(axis=1)
