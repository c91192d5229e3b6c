"""Choose the frames with which a frame is compared, by their numbers."""

from collections.abc import Iterable, Sequence

# The detection interval for which the distances in `difference.near_frames` are stated.
_NEAR_INTERVAL = 3


def pair_about(at: int, gap: int, first: int, last: int) -> tuple[int, int] | None:
    """Return the frames one gap before and after frame `at` if both lie in first..last.

    Otherwise return the frames one and two gaps away on one side, or None if they do not lie in first..last either.
    """
    return _first_within([(at - gap, at + gap), (at + gap, at + 2 * gap), (at - gap, at - 2 * gap)], first, last)


def near_gaps(near_frames: Sequence[int], wide_frames: int, interval: int) -> list[int]:
    """Return the distances to the near frames at a detection interval.

    Without a wide pair the longest distance, which is stated for an interval of 3 frames, scales with the interval. It
    is at most the larger of its stated value and the interval.
    """
    if wide_frames:
        return list(near_frames)
    longest = max(near_frames)
    far = min(max(round(longest * interval / _NEAR_INTERVAL), 1), max(longest, interval))
    return [far if gap == longest else gap for gap in near_frames]


def near_pairs(at: int, gaps: Sequence[int], first: int, last: int) -> list[tuple[int, int]]:
    """Return the near pairs of frames with which a frame is compared, within first..last. The list may be empty."""
    # Near an end of the range gaps shrink, so that pairs stay symmetric. At the end itself use the closest one-sided
    # pair: such a pair also marks the target's next positions, and more so with a longer gap.
    if room := min(at - first, last - at):
        return list(dict.fromkeys((at - min(gap, room), at + min(gap, room)) for gap in gaps))
    pair = pair_about(at, 1, first, last)
    return [] if pair is None else [pair]


def later_pair(at: int, interval: int, first: int, last: int) -> list[tuple[int, int]]:
    """Return the source's pair in a list: one and two intervals later. At an end use earlier or closer frames."""
    later = [(at + side * gap, at + 2 * side * gap) for gap in range(interval, 0, -1) for side in (1, -1)]
    # The middle frame of three has one neighbour on each side.
    pair = _first_within([*later, (at - 1, at + 1)], first, last)
    return [] if pair is None else [pair]


def next_pair(at: int, interval: int, first: int, last: int) -> list[tuple[int, int]]:
    """Return one pair of equal frames in a list: one interval later. At an end use an earlier or closer frame."""
    single = [(at + side * gap, at + side * gap) for gap in range(interval, 0, -1) for side in (1, -1)]
    pair = _first_within(single, first, last)
    return [] if pair is None else [pair]


def _first_within(pairs: Iterable[tuple[int, int]], first: int, last: int) -> tuple[int, int] | None:
    return next((pair for pair in pairs if first <= min(pair) and max(pair) <= last), None)
