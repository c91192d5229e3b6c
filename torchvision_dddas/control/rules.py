"""The feedback rules: how results change the parameters of the next frames, and the log of these changes."""

from dataclasses import dataclass, replace

import numpy as np

from torchvision_dddas.config import Settings, SteeringParameters
from torchvision_dddas.detection import WALKER_M_S
from torchvision_dddas.types import Adjustment

# Of so many frames one is processed: no parameter, but named like one in the record.
SAMPLING = "sampling.every"
# What load shedding changes.
SHED = ("registration.keypoints", "people.look_share", SAMPLING)
# Between two processed frames a target moves by this share of its size at most.
_MOVED_SHARE = 0.5
# How wide a person shows with a shadow: who comes into the picture is at least that.
_WALKER_M = 1.0
# If a frame takes this many times its budget, the load is lowered to the minimum at once.
_FAR_OVER = 2.0
# The load is raised again only if the expected time is at most this share of the budget. Otherwise it would oscillate.
_SPARE = 0.9
# Expected cost of twice the keypoints, or of a wider search, as a multiple of the present cost.
_DEARER = 1.4
# Smallest share of the windows that a search for people takes.
_LEAST_SHARE = 0.002
# The longest wait before the load is raised again, in units of calm_s.
_MOST_PATIENCE = 16.0


def every_wanted(
    interval: float, rate_hz: float, speed_m_s: np.ndarray, size_m: np.ndarray, parameters: SteeringParameters
) -> tuple[float, str]:
    """Of how many frames one should be processed, before rounding and bounds; in words what limits it beside the rule.

    interval: as the rule gives it, before its bounds; sampling_share of it is taken. speed_m_s, size_m: (N,) of the
    targets that are known. Between two frames none may move by more than half its size: the two places then still share
    half of it, and are nearer to each other than to any other target, since two that part are a size apart. Where none
    is known, so that a walker who comes into the picture is found.
    """
    wanted = parameters.sampling_share * interval
    known = np.isfinite(speed_m_s) & np.isfinite(size_m) & (size_m > 0)
    if not known.any():
        most = max(float(np.floor(_MOVED_SHARE * _WALKER_M * rate_hz / WALKER_M_S)), 1.0)
        return (most, "; nothing is found yet") if most < min(wanted, parameters.maximum_every) else (wanted, "")
    speed_m_s, size_m = speed_m_s[known], size_m[known]
    frames = _MOVED_SHARE * size_m * rate_hz / np.maximum(speed_m_s, 1e-3)
    k = int(frames.argmin())
    if frames[k] >= min(wanted, parameters.maximum_every):
        return wanted, ""
    # Whole frames, so that it holds.
    return max(float(np.floor(frames[k])), 1.0), f"; a target of {size_m[k]:.1f} m goes at {speed_m_s[k]:.1f} m/s"


def every_least(pixels_per_metre: float, rate_hz: float, parameters: SteeringParameters) -> float:
    """Of how many frames one is processed at the least: between two of them a walker must move far enough to show."""
    return parameters.least_move_px * rate_hz / (WALKER_M_S * pixels_per_metre)


def sampled(
    frame: int, now: int, wanted: float, why: str, parameters: SteeringParameters
) -> tuple[int, tuple[Adjustment, ...]]:
    """Of how many frames one is processed from here on, and the record of its change; steady as `adjust_interval`."""
    new = int(np.clip(round(min(wanted, 1e6)), 1, parameters.maximum_every))
    if new == now or (abs(new - now) == 1 and abs(wanted - now) < 0.75):
        return now, ()
    return new, (Adjustment(frame, SAMPLING, now, new, why),)


# Load shedding.


@dataclass(frozen=True)
class Load:
    """How much less than everything is processed, because it takes too long: a rung of `rungs`, 0 is everything.

    spare_s: since when there is time for more; None while there is none. eased_s: when more was last processed again.
    patience: by how much longer than calm_s time must be spare, because it was not enough the last time.
    """

    rung: int = 0
    spare_s: float | None = None
    eased_s: float = -np.inf
    patience: float = 1.0


def rungs(base: Settings, people: bool = False) -> list[dict[str, float]]:
    """The levels of load, from full to least: the same parameters by name in each, `sampling.every` the last.

    First keypoints are halved, then, where people are searched for in regions, a search takes a smaller share of the
    windows, both of which make a frame cheaper; then only every 2nd, 3rd, ... picture is processed.
    """
    live, search = base.live, base.people
    narrows = people and search.search == "regions"
    rung: dict[str, float] = {"registration.keypoints": base.registration.keypoints}
    rung |= {"people.look_share": search.look_share} if narrows else {}
    made = [rung | {SAMPLING: 1}]
    while (keypoints := made[-1]["registration.keypoints"]) > live.least_keypoints:
        made.append(made[-1] | {"registration.keypoints": max(int(keypoints) // 2, live.least_keypoints)})
    for narrower in (2, 4, 8) if narrows else ():
        made.append(made[-1] | {"people.look_share": max(search.look_share / narrower, _LEAST_SHARE)})
    return made + [made[-1] | {SAMPLING: every} for every in range(2, live.maximum_every + 1)]


def shed(
    frame: int, now: Load, cost_s: float, apart_s: float, now_s: float, base: Settings, people: bool = False
) -> tuple[Load, tuple[Adjustment, ...]]:
    """How much is processed from here on, and the record of what changed.

    cost_s: what a frame takes, as things are; apart_s: from picture to picture, 0: they wait. now_s: by any clock.
    Less: a rung, when frames take more than `live.load` of the time between them, or a picture more than its deadline;
    all that makes a frame cheaper, and as many pictures as it takes, when it is more than twice as much. More: when it
    is expected to fit for calm_s on end; for twice as long each time that it did not last.
    """
    parameters, ladder = base.live, rungs(base, people)
    at, last = min(now.rung, len(ladder) - 1), len(ladder) - 1
    if not parameters.shed or apart_s <= 0:
        return now, ()
    shares = [cost_s / (rung[SAMPLING] * apart_s) for rung in ladder]
    cheapest = next((i for i, rung in enumerate(ladder) if rung[SAMPLING] > 1), len(ladder)) - 1
    slow = cost_s * 1000 > parameters.deadline_ms and at < cheapest

    def record(to: int, limit: str) -> tuple[Adjustment, ...]:
        why = f"a look takes {cost_s * 1000:.0f} ms, {shares[at]:.0%} of the time until the next; {limit}"
        old, new = ladder[at], ladder[to]
        return tuple(Adjustment(frame, name, old[name], new[name], why) for name in new if new[name] != old[name])

    if shares[at] > parameters.load or slow:
        far = shares[at] > _FAR_OVER * parameters.load
        to = max(at, cheapest) if far else min(at + 1, last)
        # How many pictures can be had is known, what a cheaper frame costs is not.
        while (far or at >= cheapest) and shares[to] > parameters.load and to < last:
            to += 1
        undone = now_s - now.eased_s < 2 * now.patience * parameters.calm_s
        patience = min(2 * now.patience, _MOST_PATIENCE) if undone else 1.0
        over = shares[at] > parameters.load
        limit = f"{parameters.load:.0%} is allowed" if over else f"its deadline is {parameters.deadline_ms:g} ms"
        new = replace(now, rung=to, spare_s=None, patience=patience if to != at else now.patience)
        return new, record(to, limit)
    spare = _SPARE * parameters.load
    to = at
    if at > cheapest:  # how much more often it may be is known
        to = next(i for i in range(cheapest, at + 1) if i == at or shares[i] <= spare)
    elif at and _DEARER * cost_s * 1000 <= parameters.deadline_ms and _DEARER * shares[at] <= spare:
        to = at - 1
    if to == at:
        return replace(now, spare_s=None), ()
    if now.spare_s is None:
        return replace(now, spare_s=now_s), ()
    if now_s - now.spare_s < now.patience * parameters.calm_s:
        return now, ()
    made = record(to, f"for {now_s - now.spare_s:.1f} s there was time to spare")
    return replace(now, rung=to, spare_s=None, eased_s=now_s), made


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
        """A value that another line reports."""
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
