"""Which neighbours in time a window compares with its reference, within a range of frames that registration links."""

from torchvision_dddas.config import Settings

Pair = tuple[int, int]


def look_ahead(interval: int, settings: Settings) -> int:
    """How many frames ahead of its reference a window looks: at most two intervals, as in the source."""
    if settings.difference.kind == "between_later":
        return 2 * interval
    gap = max(settings.difference.near_frames)
    # At the start of a range the window looks ahead only, as far as the frames of `settling_delay` leave room.
    near = max(gap, min(2 * gap, 2 * interval - (2 if settings.persistence.on else 0)))
    wide = min(settings.difference.wide_frames, max(2 * interval - 2, 0))
    small = _small_gap(interval, settings) if _wants_small(interval, settings) else 0
    return max(near, wide, small)


def settling_delay(interval: int, settings: Settings) -> int:
    """How many further frames are observed before a frame is settled; with `look_ahead`, at most two intervals."""
    if settings.persistence.on or settings.small.on:
        return max(2, 2 * interval - look_ahead(interval, settings))
    return 0


def _wants_small(interval: int, settings: Settings) -> bool:
    # Small slow targets show only over a long interval.
    return settings.small.on and interval >= settings.small.from_interval


def _small_gap(interval: int, settings: Settings) -> int:
    return min(interval, settings.small.gap_frames)


def choose_pairs(
    at: int, interval: int, first: int, last: int, settings: Settings
) -> tuple[list[Pair], Pair | None, Pair | None]:
    """(near pairs, wide pair, small pair) of frame indices for reference `at`, within first..last; near may be empty.

    A window looks both ways where it can; at the ends of the range it looks one way only.
    """
    parameters = settings.difference
    if parameters.kind == "between_later":
        return [p for p in [_forward(at, interval, first, last)] if p], None, None
    # No further than `look_ahead`, even if more is known: the result must not depend on how frames are batched.
    ahead = min(last, at + look_ahead(interval, settings))
    near = [p for gap in parameters.near_frames if (p := _symmetric(at, gap, first, ahead))]
    if not near and (p := _symmetric(at, 1, first, ahead)):
        near = [p]
    near = list(dict.fromkeys(near))
    # One-sided pairs show a target's next places too, the more of them the longer the gap: only the closest is used,
    # and only where no pair looks both ways.
    near = [p for p in near if p[0] < at < p[1]] or near[:1]
    wide = None
    if parameters.wide_frames and near:
        forward = min(parameters.wide_frames, max(2 * interval - 2, 0), ahead - at)
        back = min(parameters.wide_frames, at - first)
        if back >= 3 and forward >= 2:
            wide = (at - back, at + forward)
        else:
            gaps = range(parameters.wide_frames, 2, -1)
            wide = next((p for gap in gaps if (p := _symmetric(at, gap, first, ahead))), None)
    small = None
    if _wants_small(interval, settings):
        small = _symmetric(at, _small_gap(interval, settings), first, ahead)
    return near, wide, small


def _symmetric(at: int, gap: int, first: int, last: int) -> Pair | None:
    tries = ((at - gap, at + gap), (at + gap, at + 2 * gap), (at - gap, at - 2 * gap))
    return next((p for p in tries if first <= min(p) and max(p) <= last), None)


def _forward(at: int, gap: int, first: int, last: int) -> Pair | None:
    for smaller in range(gap, 0, -1):
        for pair in ((at + smaller, at + 2 * smaller), (at - smaller, at - 2 * smaller)):
            if first <= min(pair) and max(pair) <= last:
                return pair
    # The middle one of three frames has a neighbour on either side only.
    return (at - 1, at + 1) if first < at < last else None
