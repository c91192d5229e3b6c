"""The feedback rules: how results change the parameters of the next frames, and the log of these changes."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from torchvision_dddas.config import (
    LiveParameters,
    Settings,
    SteeringParameters,
)
from torchvision_dddas.types import Adjustment

# Of so many frames one is looked at: no parameter, but named like one in the record.
SAMPLING = "sampling.every"

# Between two looks a target moves by this share of its size at most.
_MOVED_SHARE = 0.5

# How fast people walk, and how wide one shows with his shadow: who comes into the picture is at least that.
_WALKER_M_S, _WALKER_M = 1.4, 1.0

# Looks that take so many times what they may are made as cheap as can be at once.
_FAR_OVER = 2.0
# More is looked at again where it is expected to take this share of what it may at most: else it would flutter.
_SPARE = 0.9
# Twice the keypoints, or a wider search, is expected to cost so many times as much.
_DEARER = 1.4
# A look at people takes this share of the windows at the least.
_LEAST_SHARE = 0.002
# The longest wait before more is looked at again, in calm_s.
_MOST_PATIENCE = 16.0


def every_wanted(
    interval: float, rate_hz: float, speed_m_s: np.ndarray, size_m: np.ndarray, parameters: SteeringParameters
) -> tuple[float, str]:
    """Of how many frames one is worth a look, before rounding and bounds; in words what limits it beside the rule.

    interval: as the rule gives it, before its bounds; sampling_share of it is taken. speed_m_s, size_m: (N,) of the
    targets that are known. Between two looks none may move by more than half its size: the two places then still share
    half of it, and are nearer to each other than to any other target, since two that part are a size apart. Where none
    is known, so that a walker who comes into the picture is found.
    """
    wanted = parameters.sampling_share * interval
    known = np.isfinite(speed_m_s) & np.isfinite(size_m) & (size_m > 0)
    if not known.any():
        most = max(float(np.floor(_MOVED_SHARE * _WALKER_M * rate_hz / _WALKER_M_S)), 1.0)
        return (most, "; nothing is found yet") if most < min(wanted, parameters.maximum_every) else (wanted, "")
    frames = _MOVED_SHARE * size_m[known] * rate_hz / np.maximum(speed_m_s[known], 1e-3)
    tightest = int(frames.argmin())
    if frames[tightest] >= min(wanted, parameters.maximum_every):
        return wanted, ""
    speed, size = speed_m_s[known][tightest], size_m[known][tightest]
    # Whole frames, so that it holds.
    return max(float(np.floor(frames[tightest])), 1.0), f"; a target of {size:.1f} m goes at {speed:.1f} m/s"


def every_least(pixels_per_metre: float, rate_hz: float, parameters: SteeringParameters) -> float:
    """Of how many frames one is worth a look at the least: between two looks a walker must move far enough to show."""
    return parameters.least_move_px * rate_hz / (_WALKER_M_S * pixels_per_metre)


def sampled(
    frame: int, now: int, wanted: float, why: str, parameters: SteeringParameters
) -> tuple[int, tuple[Adjustment, ...]]:
    """Of how many frames one is looked at from here on, and the record of its change; steady as `adjust_interval`."""
    new = int(np.clip(round(min(wanted, 1e6)), 1, parameters.maximum_every))
    if new == now or (abs(new - now) == 1 and abs(wanted - now) < 0.75):
        return now, ()
    return new, (Adjustment(frame, SAMPLING, now, new, why),)


@dataclass(frozen=True)
class Load:
    """How much less than everything is looked at, because it takes too long: a rung of `rungs`, 0 is everything.

    spare_s: since when there is time for more; None while there is none. eased_s: when more was last looked at again.
    patience: by how much longer than calm_s time must be spare, because it was not enough the last time.
    """

    rung: int = 0
    spare_s: float | None = None
    eased_s: float = -np.inf
    patience: float = 1.0


def rungs(base: Settings, people: bool = False) -> list[dict[str, float]]:
    """The levels of load, from full to least: the same parameters by name in each, `sampling.every` the last.

    First keypoints are halved, then, where people are searched for in regions, a look takes a smaller share of the
    windows, both of which make it cheaper; then only every 2nd, 3rd, ... picture is looked at.
    """
    live, search = base.live, base.people
    rung: dict[str, float] = {"registration.keypoints": base.registration.keypoints}
    if people and search.search == "regions":
        rung["people.look_share"] = search.look_share
    rung[SAMPLING] = 1
    made = [rung]
    while (keypoints := made[-1]["registration.keypoints"]) > live.least_keypoints:
        fewer = max(int(keypoints) // 2, live.least_keypoints)
        made.append(made[-1] | {"registration.keypoints": fewer})
    if "people.look_share" in rung:
        for narrower in (2, 4, 8):
            made.append(made[-1] | {"people.look_share": max(search.look_share / narrower, _LEAST_SHARE)})
    made += [made[-1] | {SAMPLING: every} for every in range(2, live.maximum_every + 1)]
    return made


def shed(
    frame: int, now: Load, cost_s: float, apart_s: float, now_s: float, base: Settings, people: bool = False
) -> tuple[Load, tuple[Adjustment, ...]]:
    """How much is looked at from here on, and the record of what changed.

    cost_s: what a look takes, as things are; apart_s: from picture to picture, 0: they wait. now_s: by any clock.
    Less: a rung, when looks take more than `live.load` of the time between them, or a picture more than its deadline;
    all that makes a look cheaper, and as many pictures as it takes, when it is more than twice as much. More: when it
    is expected to fit for calm_s on end; for twice as long each time that it did not last.
    """
    parameters, ladder = base.live, rungs(base, people)
    at = min(now.rung, len(ladder) - 1)
    if not parameters.shed or apart_s <= 0:
        return now, ()
    shares = [cost_s / (rung[SAMPLING] * apart_s) for rung in ladder]
    cheapest = next((i for i, rung in enumerate(ladder) if rung[SAMPLING] > 1), len(ladder)) - 1
    slow = cost_s * 1000 > parameters.deadline_ms and at < cheapest
    if shares[at] > parameters.load or slow:
        far = shares[at] > _FAR_OVER * parameters.load
        to = max(at, cheapest) if far else min(at + 1, len(ladder) - 1)
        # How many pictures can be had is known, what a cheaper look costs is not.
        while (far or at >= cheapest) and shares[to] > parameters.load and to < len(ladder) - 1:
            to += 1
        undone = now_s - now.eased_s < 2 * now.patience * parameters.calm_s
        patience = min(2 * now.patience, _MOST_PATIENCE) if undone else 1.0
        new = replace(now, rung=to, spare_s=None, patience=patience if to != at else now.patience)
        limit = (
            f"{parameters.load:.0%} is allowed"
            if shares[at] > parameters.load
            else f"its deadline is {parameters.deadline_ms:g} ms"
        )
        return new, _moved(frame, ladder[at], ladder[to], _took(cost_s, shares[at], limit))
    to = _eased(at, shares, cost_s, cheapest, parameters)
    if to == at:
        return replace(now, spare_s=None), ()
    if now.spare_s is None:
        return replace(now, spare_s=now_s), ()
    if now_s - now.spare_s < now.patience * parameters.calm_s:
        return now, ()
    why = _took(cost_s, shares[at], f"for {now_s - now.spare_s:.1f} s there was time to spare")
    return replace(now, rung=to, spare_s=None, eased_s=now_s), _moved(frame, ladder[at], ladder[to], why)


def _eased(at: int, shares: Sequence[float], cost_s: float, cheapest: int, parameters: LiveParameters) -> int:
    """The rung that is expected to fit with time to spare, if lower than `at`."""
    if at > cheapest:  # how much more often it may be is known
        return next(i for i in range(cheapest, at + 1) if i == at or shares[i] <= _SPARE * parameters.load)
    dearer = _DEARER * cost_s * 1000 <= parameters.deadline_ms and _DEARER * shares[at] <= _SPARE * parameters.load
    return at - 1 if at and dearer else at


def _took(cost_s: float, share: float, limit: str) -> str:
    return f"a look takes {cost_s * 1000:.0f} ms, {share:.0%} of the time until the next; {limit}"


def _moved(frame: int, old: dict[str, float], new: dict[str, float], why: str) -> tuple[Adjustment, ...]:
    return tuple(Adjustment(frame, name, old[name], value, why) for name, value in new.items() if value != old[name])


class AdjustmentLog:
    """The values in force by name, and the adjustments of the present frame."""

    def __init__(self) -> None:
        self.frame = 0
        self._values: dict[str, float] = {}
        self._made: list[Adjustment] = []

    def begin(self, frame: int) -> None:
        """All that is set from here on happened at this frame."""
        self.frame, self._made = frame, []

    def set(self, parameter: str, new: float, cause: str, old: float = 0.0, least: float = 0.0) -> None:
        """Write a value down where it differs by more than `least` from the one in force; old: the one at first."""
        now = self._values.setdefault(parameter, old)
        if abs(new - now) > least:
            self._values[parameter] = new
            self._made.append(Adjustment(self.frame, parameter, float(now), float(new), cause))

    def know(self, parameter: str, value: float) -> None:
        """A value that another line tells."""
        self._values[parameter] = value

    def add(self, adjustments: tuple[Adjustment, ...]) -> None:
        """Take over what another rule wrote."""
        self._made.extend(adjustments)

    def made(self) -> tuple[Adjustment, ...]:
        """The adjustments of the present frame, in order."""
        return tuple(self._made)


def count_of(n: int, what: str) -> str:
    """1 target, 2 targets."""
    return f"{n} {what}" + ("" if n == 1 else "s")
