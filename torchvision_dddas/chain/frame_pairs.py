"""Which frames a frame is compared with, by their numbers."""

from collections.abc import Iterable, Sequence

# The detection interval that distances to near frames are meant for.
_NEAR_INTERVAL = 3


def pair_about(at: int, gap: int, first: int, last: int) -> tuple[int, int] | None:
    """Two frames of first..last a gap apart from frame `at` on both sides, else two on one side, else None."""
    return _first_within([(at - gap, at + gap), (at + gap, at + 2 * gap), (at - gap, at - 2 * gap)], first, last)


def near_gaps(near_frames: Sequence[int], wide_frames: int, interval: int) -> list[int]:
    """Distances to the frames that a frame is compared with at a detection interval.

    Without a wide pair the longest, which is meant for 3 frames, follows the interval in proportion, up to its length.
    """
    if wide_frames:
        return list(near_frames)
    longest = max(near_frames)
    far = min(max(round(longest * interval / _NEAR_INTERVAL), 1), max(longest, interval))
    return [far if gap == longest else gap for gap in near_frames]


def near_pairs(at: int, gaps: Sequence[int], first: int, last: int) -> list[tuple[int, int]]:
    """The pairs of frames that a frame is compared with, within first..last; may be empty."""
    # Near an end gaps shrink, so that pairs look both ways. At the end itself one looks one way only, to the closest
    # frames: it shows a target's next places too, the more of them the longer its gap.
    if room := min(at - first, last - at):
        return list(dict.fromkeys((at - min(gap, room), at + min(gap, room)) for gap in gaps))
    pair = pair_about(at, 1, first, last)
    return [] if pair is None else [pair]


def later_pair(at: int, interval: int, first: int, last: int) -> list[tuple[int, int]]:
    """The source's pair: one and two intervals later, else earlier, at the shortest one frame; may be empty."""
    later = [(at + side * gap, at + 2 * side * gap) for gap in range(interval, 0, -1) for side in (1, -1)]
    # The middle one of three frames has a neighbour on either side only.
    pair = _first_within([*later, (at - 1, at + 1)], first, last)
    return [] if pair is None else [pair]


def next_pair(at: int, interval: int, first: int, last: int) -> list[tuple[int, int]]:
    """The one frame that a two-frame difference looks at, as a pair of itself: later, else earlier; may be empty."""
    single = [(at + side * gap, at + side * gap) for gap in range(interval, 0, -1) for side in (1, -1)]
    pair = _first_within(single, first, last)
    return [] if pair is None else [pair]


def _first_within(pairs: Iterable[tuple[int, int]], first: int, last: int) -> tuple[int, int] | None:
    return next((pair for pair in pairs if first <= min(pair) and max(pair) <= last), None)
