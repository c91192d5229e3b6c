"""The feedback rules: how results change the parameters of the next frames, and the log of these changes."""

from dataclasses import dataclass, replace

import numpy as np

from torchvision_dddas.config import Settings, SteeringParameters
from torchvision_dddas.detection import WALKER_M_S
from torchvision_dddas.types import Adjustment

# Name of k in "one of k frames is processed". It is not a parameter, but the record names it like one.
SAMPLING = "sampling.every"
# The names that load shedding changes.
SHED = ("registration.keypoints", "people.look_share", SAMPLING)
# Largest motion of a target between two processed frames, as a share of its size.
_MOVED_SHARE = 0.5
# Assumed width of a person with a shadow, for people who enter the picture.
_WALKER_M = 1.0
# If a frame takes more than this many times its budget, the load is lowered to the minimum at once.
_FAR_OVER = 2.0
# The load is raised again only if the expected time is at most this share of the budget. The growing `patience`
# prevents oscillation. With 0.9, a frame of 31 ms in 40 ms kept a run at every second picture after a short burst.
_SPARE = 0.96
# Expected cost with twice the keypoints, or with a wider search, as a multiple of the current cost.
_DEARER = 1.4
# Smallest share of the windows that a search for people takes.
_LEAST_SHARE = 0.002
# The longest wait before the load is raised again, in units of calm_s.
_MOST_PATIENCE = 16.0


def every_wanted(
    interval: float, rate_hz: float, speed_m_s: np.ndarray, size_m: np.ndarray, parameters: SteeringParameters
) -> tuple[float, str]:
    """Return k, so that one of k frames should be processed, before rounding and bounds, and its limit in words.

    interval: the rule's detection interval before its bounds; k = sampling_share * interval. speed_m_s, size_m: (N,) of
    the known targets. k is limited so that no target moves by more than half its size between two processed frames.
    Its two positions then overlap by half, and are nearer to each other than to any other target. Without a known
    target, k is limited by the motion of a walker who enters the picture. The text is "" if only the rule limits k.
    """
    wanted = parameters.sampling_share * interval
    known = np.isfinite(speed_m_s) & np.isfinite(size_m) & (size_m > 0)
    if not known.any():
        most = max(float(np.floor(_MOVED_SHARE * _WALKER_M * rate_hz / WALKER_M_S)), 1.0)
        return (most, "; no target is known yet") if most < min(wanted, parameters.maximum_every) else (wanted, "")
    speed_m_s, size_m = speed_m_s[known], size_m[known]
    frames = _MOVED_SHARE * size_m * rate_hz / np.maximum(speed_m_s, 1e-3)
    k = int(frames.argmin())
    if frames[k] >= min(wanted, parameters.maximum_every):
        return wanted, ""
    # Round down, so that the limit holds.
    return max(float(np.floor(frames[k])), 1.0), f"; a target of {size_m[k]:.1f} m moves at {speed_m_s[k]:.1f} m/s"


def every_least(pixels_per_metre: float, rate_hz: float, parameters: SteeringParameters) -> float:
    """Return the smallest k (one of k frames is processed) for which a walker moves by least_move_px."""
    return parameters.least_move_px * rate_hz / (WALKER_M_S * pixels_per_metre)


def sampled(
    frame: int, now: int, wanted: float, why: str, parameters: SteeringParameters
) -> tuple[int, tuple[Adjustment, ...]]:
    """Return k (process one of k frames) from this frame on, and its change; hysteresis as in `adjust_interval`."""
    new = int(np.clip(round(min(wanted, 1e6)), 1, parameters.maximum_every))
    if new == now or (abs(new - now) == 1 and abs(wanted - now) < 0.75):
        return now, ()
    return new, (Adjustment(frame, SAMPLING, now, new, why),)


# Load shedding.


@dataclass(frozen=True)
class Load:
    """The current level of load shedding.

    rung: index into `rungs`, 0 for the full load. spare_s: time since which there has been spare time, None without
    spare time. eased_s: time at which the load was last raised. patience: factor on calm_s, the time for which there
    must be spare time before the load is raised; it grows if the load had to be lowered soon after it was raised.
    """

    rung: int = 0
    spare_s: float | None = None
    eased_s: float = -np.inf
    patience: float = 1.0


def rungs(base: Settings, people: bool = False) -> list[dict[str, float]]:
    """Return the levels of load from full to least. All have the same parameters by name; `sampling.every` is the last.

    First the keypoints are halved. Then, if people are searched for in regions, a search takes a smaller share of the
    windows. Both make a frame cheaper. Then only every 2nd, 3rd, ... picture is processed.
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
    """Return the level of load from this frame on, and the record of changes.

    cost_s: computing time of a frame at the current level. apart_s: time between pictures; 0 if pictures wait, as in a
    file. now_s: time by any clock. The load is lowered by one level if frames take more than `live.load` of the time
    between them, or a picture takes longer than its deadline. If frames take more than twice that share, all levels
    that make a frame cheaper are applied at once, and as many pictures are skipped as necessary. The load is raised if
    the next level is expected to fit for calm_s without a break; this time doubles whenever a raise did not last.
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
        # Only the effect of skipping pictures is known, so only then apply as many levels as needed at once.
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
    if at > cheapest:  # the cost of processing more pictures is known, so several levels may be raised at once
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
    """The current values by name, and the adjustments of the current frame."""

    def __init__(self) -> None:
        self.frame = 0
        self._values: dict[str, float] = {}
        self._made: list[Adjustment] = []

    def begin(self, frame: int) -> None:
        """Start recording adjustments for this frame."""
        self.frame, self._made = frame, []

    def set(self, parameter: str, new: float, cause: str, old: float = 0.0, least: float = 0.0) -> None:
        """Record a new value if it differs by more than `least`. old: the value before the first call."""
        now = self._values.setdefault(parameter, old)
        if abs(new - now) > least:
            self._values[parameter] = new
            self._made.append(Adjustment(self.frame, parameter, float(now), float(new), cause))

    def know(self, parameter: str, value: float) -> None:
        """Set a current value without an adjustment, because another adjustment states it."""
        self._values[parameter] = value

    def add(self, adjustments: tuple[Adjustment, ...]) -> None:
        """Add the adjustments of another rule."""
        self._made.extend(adjustments)

    def made(self) -> tuple[Adjustment, ...]:
        """Return the adjustments of the current frame, in order."""
        return tuple(self._made)


def count_of(n: int, what: str) -> str:
    """Return a count with its noun: 1 target, 2 targets."""
    return f"{n} {what}" + ("" if n == 1 else "s")
