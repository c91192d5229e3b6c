"""Which frames a window looks at: its neighbours in time, within a stretch of frames that hang together."""

from collections.abc import Callable

from torchvision_dddas.config import Settings

Pair = tuple[int, int]


def reach(interval: int, settings: Settings) -> int:
    """How many frames ahead of its reference a window looks, never more than the source's two intervals."""
    if settings.difference.kind == "between_later":
        return 2 * interval
    gap = max(settings.difference.near_frames)
    # At a stretch's start the window looks ahead only, as far as the frames that `delay` waits for leave room.
    near = max(gap, min(2 * gap, 2 * interval - (2 if settings.persistence.on else 0)))
    wide = min(settings.difference.wide_frames, max(2 * interval - 2, 0))
    small = small_gap(interval, settings) if small_looked_for(interval, settings) else 0
    return max(near, wide, small)


def delay(interval: int, settings: Settings) -> int:
    """How many further frames are observed before a frame is settled; with `reach`, two intervals at most."""
    if settings.persistence.on or settings.small.on:
        return max(2, 2 * interval - reach(interval, settings))
    return 0


def small_looked_for(interval: int, settings: Settings) -> bool:
    """Small slow targets show only over a long interval."""
    return settings.small.on and interval >= settings.small.from_interval


def small_gap(interval: int, settings: Settings) -> int:
    """How far the neighbours are that show small targets: the slower the scene, the further."""
    return min(interval, settings.small.gap_frames)


def pairs(
    at: int, interval: int, first: int, last: int, settings: Settings
) -> tuple[list[Pair], Pair | None, Pair | None]:
    """(near pairs, wide pair, small pair) of frame indices for reference `at`, within first..last; near may be empty.

    A window looks both ways where it can; at the ends of a stretch it looks one way only.
    """
    parameters = settings.difference
    if parameters.kind == "between_later":
        return [p for p in [_forward(at, interval, first, last)] if p], None, None
    # No further than the reach, whatever is known already: the result must not depend on how frames are batched.
    ahead = min(last, at + reach(interval, settings))
    near = [p for gap in parameters.near_frames if (p := _symmetric(at, gap, first, ahead))]
    if not near and (p := _symmetric(at, 1, first, ahead)):
        near = [p]
    near = list(dict.fromkeys(near))
    # One-sided pairs see a target's next places too, the more of them the longer the gap: only the closest will do,
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
    if small_looked_for(interval, settings):
        small = _symmetric(at, small_gap(interval, settings), first, ahead)
    return near, wide, small


def _symmetric(at: int, gap: int, first: int, last: int) -> Pair | None:
    tries = ((at - gap, at + gap), (at + gap, at + 2 * gap), (at - gap, at - 2 * gap))
    return next((p for p in tries if first <= min(p) and max(p) <= last), None)


def _forward(at: int, gap: int, first: int, last: int) -> Pair | None:
    tries: tuple[Callable[[int], Pair], ...] = (lambda g: (at + g, at + 2 * g), lambda g: (at - g, at - 2 * g))
    for smaller in range(gap, 0, -1):
        for make in tries:
            pair = make(smaller)
            if first <= min(pair) and max(pair) <= last:
                return pair
    # The middle one of three frames has a neighbour on either side only.
    return (at - 1, at + 1) if first < at < last else None
