"""Gradient descent on parameters: Adam, annealed softness, early stopping on watched examples."""

import hashlib
import json
import math
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

import torch
from torch import Tensor

from torchvision_dddas.config import Settings, changes
from torchvision_dddas.errors import InputError
from torchvision_dddas.lab.tuning.checkpoint import read_checkpoint, write_checkpoint
from torchvision_dddas.lab.tuning.family import Example, Family
from torchvision_dddas.lab.tuning.parameters import TUNABLE, Parameters

FINAL_RATE = 0.1
"""Learning rate at the last step, as a share of the first."""

SIZES_FIXED = 0.5
"""After this share of the steps, sizes are fixed to whole numbers and only other parameters move, if there are any."""

GAIN = 1e-5
"""A smaller reduction of the loss is rounding, and does not justify a change of a parameter."""


@dataclass(frozen=True)
class Plan:
    """Settings of a descent. rate: learning rate of Adam; a step of 1 changes most parameters by a factor of about e.

    look_every: steps between two measurements of the watched examples. patience: number of measurements without a gain
    that end the descent. watched: share of each clip's examples that is held back for these measurements; the last
    examples are taken. most_watched: limit for all clips together. most_s: no step begins after this many seconds.
    pull: weight in the loss of half the squared distance from the start, in the unit of the rate; it holds parameters
    in place that the examples hardly determine.

    Raise InputError for a value out of its range.
    """

    steps: int = 100
    batch: int = 8
    rate: float = 0.05
    seed: int = 0
    look_every: int = 5
    patience: int = 10
    watched: float = 0.25
    most_watched: int = 32
    most_s: float = math.inf
    pull: float = 0.0

    def __post_init__(self) -> None:
        for name in ("steps", "batch", "look_every", "patience", "most_watched"):
            if getattr(self, name) < 1:
                raise InputError(f"{name} must be 1 or more, got {getattr(self, name)}")
        if not 0 < self.rate <= 10:
            raise InputError(f"rate must be more than 0 and at most 10, got {self.rate:g}")
        if not 0 <= self.watched <= 0.9:
            raise InputError(f"watched must be between 0 and 0.9, got {self.watched:g}")
        if not 0 <= self.pull < math.inf:
            raise InputError(f"pull must be 0 or more, got {self.pull:g}")


@dataclass(frozen=True)
class DescentStep:
    """The parameters and losses after a step; step 0 is the start.

    loss: loss of the step's batch, NaN at step 0. watched: mean loss of the watched examples at the final softness;
    None if they were not measured.
    """

    step: int
    softness: float
    loss: float
    watched: float | None
    parameters: Mapping[str, float]


@dataclass
class Descended:
    """The result of a descent. parameters: the best state, after step `best`. ended: the reason for the end.

    failed: one line with the clip, frame and parameter of a value that is not finite; else empty. idle: parameters
    without any effect on the loss. taken: number of steps in `seconds`, without the steps of a checkpoint.
    """

    parameters: Parameters
    best: int
    history: list[DescentStep] = field(default_factory=list)
    ended: str = ""
    failed: str = ""
    seconds: float = 0.0
    idle: tuple[str, ...] = ()
    taken: int = 0

    @property
    def settings(self) -> Settings:
        """The settings of the best state."""
        return self.parameters.settings()


def descend(
    family: Family,
    parameters: Parameters,
    examples: Sequence[Example],
    plan: Plan | None = None,
    tell: Callable[[DescentStep], object] = lambda step: None,
    place: Path | None = None,
    resume: bool = False,
) -> Descended:
    """Minimize the family's loss. The parameters are changed in place and end in their best state.

    tell: called with each step, also with a checkpoint's steps. place: file of a checkpoint, written at every
    measurement. resume: continue from the checkpoint if it exists. Raise InputError if there are no examples, if no
    parameter has an effect on the loss, if the loss is not finite at the start, and for another descent's checkpoint.
    """
    plan = plan or Plan()
    if not examples:
        raise InputError(f"no clip has an example to tune {family.name} on; give clips with the truth that it needs")
    run = _Run(family, parameters, examples, plan)
    began = time.perf_counter()
    if resume and place is not None and place.is_file():
        run.load(place)
    resumed = run.history[-1].step if run.history else 0
    for step in run.history:
        tell(step)
    if not run.history:
        tell(run.begin())
        run.save(place)
    while not (run.ended or run.failed):
        if time.perf_counter() - began >= plan.most_s:
            run.stop(f"the limit of {plan.most_s:g} s was reached")
            break
        taken = run.step()
        if taken is not None:
            tell(taken)
        if taken is None or taken.watched is not None:
            run.save(place)
    parameters.load_state_dict(run.best)
    return Descended(
        parameters,
        run.best_step,
        run.history,
        run.ended or "a loss was not finite",
        run.failed,
        time.perf_counter() - began,
        tuple(name for name in parameters.names if len(run.history) > 1 and name not in run.moved),
        run.history[-1].step - resumed,
    )


class _Run:
    """A descent in progress.

    moved: parameters that had a gradient. best, least, best_step: the best state, its watched loss and its step. since:
    number of measurements since the last gain.
    """

    _SAVED = ("best", "least", "best_step", "since", "ended", "failed")

    def __init__(self, family: Family, parameters: Parameters, examples: Sequence[Example], plan: Plan) -> None:
        self._family, self._parameters, self._plan = family, parameters, plan
        self._learned, self._watched = split_examples(examples, plan.watched, plan.most_watched)
        self._adam = torch.optim.Adam(parameters.parameters(), lr=plan.rate, betas=(0.9, 0.99))
        self._hardest = family.softness[1]
        self.moved: set[str] = set()
        self.best: dict[str, Tensor] = {}
        self.least, self.best_step, self.since = math.inf, 0, 0
        self.history: list[DescentStep] = []
        self.ended = self.failed = ""
        # Facts that determine the descent, which a checkpoint must match.
        used = "\n".join(f"{example.clip} {example.frame}" for example in (*self._learned, *self._watched))
        self._facts = {
            "family": family.name,
            "task": family.task,
            "interval": family.interval,
            "knobs": ", ".join(parameters.names),
            "settings": json.dumps(changes(parameters.base), default=str),
            **{name: value for name, value in asdict(plan).items() if name != "most_s"},
            "examples": hashlib.sha256(used.encode()).hexdigest()[:16],
        }

    def begin(self) -> DescentStep:
        """Measure the loss at the start."""
        with torch.no_grad():
            values = self._parameters.values()
        if cause := self._explain(self._watched, values, self._hardest):
            raise InputError(f"{cause}, before the first step")
        return self._record(0, self._softness(1), math.nan, measure=True)

    def step(self) -> DescentStep | None:
        """Take one step; return None if it failed."""
        plan, number = self._plan, self.history[-1].step + 1
        softness = self._softness(number)
        clips = [example.clip for example in self._learned]
        batch = [self._learned[i] for i in draw_batch(number - 1, clips, plan.batch, plan.seed)]
        has_others = any(TUNABLE[name].rounding == "none" for name in self.moved)
        whole = number > SIZES_FIXED * plan.steps and has_others
        values = self._parameters.values(whole)
        for value in values.values():
            if value.requires_grad:
                value.retain_grad()
        wrong = self._family.loss(values, batch, softness).mean()
        loss = wrong + self._pull_term(whole)
        if not bool(torch.isfinite(loss)):
            self._fail(number, batch, values, softness)
            return None
        # The loss of one batch may depend on no parameter, but the loss of all examples must depend on some.
        if not wrong.requires_grad and not self.moved:
            parts = self._parts(self._learned)
            if not any(self._family.loss(values, part, softness).requires_grad for part in parts):
                raise InputError(f"the loss of {self._family.name} does not depend on {', '.join(values)}")
        self._adam.zero_grad()
        if loss.requires_grad:
            loss.backward()
        gradients = {name: value.grad for name, value in values.items() if value.grad is not None}
        if not all(bool(torch.isfinite(gradient).all()) for gradient in gradients.values()):
            self._fail(number, batch, values, softness)
            return None
        self.moved |= {name for name, gradient in gradients.items() if bool(gradient.any())}
        for group in self._adam.param_groups:
            group["lr"] = plan.rate * (1 - (1 - FINAL_RATE) * (number - 1) / plan.steps)
        self._adam.step()
        is_last = number == plan.steps
        step = self._record(number, softness, float(loss.detach()), is_last or number % plan.look_every == 0)
        if is_last and not self.ended:
            self.ended = f"all {number} steps were taken"
        return None if self.failed else step

    def stop(self, reason: str) -> None:
        """End the descent, with a measurement of the last state."""
        last = self.history[-1]
        if last.watched is None:
            self.history.pop()
            self._record(last.step, last.softness, last.loss, measure=True)
        self.ended = self.ended or reason

    def load(self, place: Path) -> None:
        """Continue from a checkpoint. Raise InputError for one of another descent."""
        state = read_checkpoint(place, self._facts)
        self._parameters.load_state_dict(state["knobs"])
        self._adam.load_state_dict(state["adam"])
        self.moved, self.history = set(state["moved"]), [DescentStep(**step) for step in state["history"]]
        for name in self._SAVED:
            setattr(self, name, state[name])

    def save(self, place: Path | None) -> None:
        """Write a checkpoint. Raise InputError if the disk refuses."""
        if place is not None:
            state = {
                "knobs": self._parameters.state_dict(),
                "adam": self._adam.state_dict(),
                "moved": sorted(self.moved),
                "history": [asdict(step) for step in self.history],
            }
            write_checkpoint(place, self._facts, state | {name: getattr(self, name) for name in self._SAVED})

    def _record(self, number: int, softness: float, loss: float, measure: bool) -> DescentStep:
        """Record the current parameters and, if `measure` is set, the loss of the watched examples."""
        watched = None
        with torch.no_grad():
            values = {name: float(value) for name, value in self._parameters.values().items()}
            if measure:
                # Round as the settings do: a blend of two sizes may be good although both sizes are bad.
                settled = self._parameters.settled()
                watched = self._watched_mean(settled)
        if watched is not None and not math.isfinite(watched):
            self._fail(number, self._watched, settled, self._hardest)
            return DescentStep(number, softness, loss, None, values)
        step = DescentStep(number, softness, loss, watched, values)
        self.history.append(step)
        if watched is not None and (not self.best or watched < self.least - GAIN):
            self.least, self.best_step, self.since = watched, number, 0
            self.best = {name: value.clone() for name, value in self._parameters.state_dict().items()}
        elif watched is not None:
            self.since += 1
            if self.since >= self._plan.patience:
                self.ended = f"no gain on the watched examples since step {self.best_step}"
        return step

    def _watched_mean(self, values: Mapping[str, Tensor]) -> float:
        """Return the pull plus the mean loss of the watched examples at the final softness, clips equally weighted."""
        shares = iter(clip_shares([example.clip for example in self._watched]))
        losses = (self._family.loss(values, part, self._hardest).tolist() for part in self._parts(self._watched))
        # Sum each part exactly, so that the result does not depend on the order of its examples.
        total = sum(math.fsum(loss * next(shares) for loss in part) for part in losses)
        return total + float(self._pull_term())

    def _pull_term(self, whole: bool = False) -> Tensor:
        pull = self._plan.pull
        return pull / 2 * self._parameters.moved(whole) if pull else torch.zeros((), dtype=torch.float64)

    def _parts(self, examples: Sequence[Example]) -> Iterator[Sequence[Example]]:
        return (examples[i : i + self._plan.batch] for i in range(0, len(examples), self._plan.batch))

    def _softness(self, number: int) -> float:
        first, last = self._family.softness
        share = (number - 1) / max(self._plan.steps - 1, 1)
        return first ** (1 - share) * last**share if first > 0 and last > 0 else first + (last - first) * share

    def _fail(self, number: int, batch: Sequence[Example], values: Mapping[str, Tensor], softness: float) -> None:
        self.failed = f"{self._explain(batch, values, softness) or 'the pull is not finite'}, at step {number}"

    def _explain(self, batch: Sequence[Example], values: Mapping[str, Tensor], softness: float) -> str:
        """Name the first example with a loss or gradient that is not finite, and the parameter; empty if there is none.

        A parameter is named if its earlier value alone makes the loss finite, or if its gradient is not finite.
        """

        def finite(part: Sequence[Example], values: Mapping[str, Tensor]) -> bool:
            with torch.no_grad():
                return bool(torch.isfinite(self._family.loss(values, part, softness)).all())

        if all(finite(part, values) for part in self._parts(batch)):
            return self._explain_gradient(batch, values, softness)
        problem = f"the loss of {self._family.name} is not finite for"
        example = next((one for one in batch if not finite([one], values)), None)
        if example is None:
            return f"{problem} {batch[0].clip}, frame {batch[0].frame} and the other examples of its batch"
        where = f"{problem} {example.clip}, frame {example.frame}"
        known = [self.history[i].parameters for i in (-1, self.best_step, 0)] if self.history else []
        earlier = [{name: value.new_tensor(of[name]) for name, value in values.items()} for of in known]
        good = next((before for before in earlier if finite([example], before)), None)
        if good is None:
            return f"{where}, for any parameters"
        guilty = [name for name in values if finite([example], {**values, name: good[name]})]
        return f"{where}, with {', '.join(f'{name} = {float(values[name].detach()):.6g}' for name in guilty or values)}"

    def _explain_gradient(self, batch: Sequence[Example], values: Mapping[str, Tensor], softness: float) -> str:
        if not any(value.requires_grad for value in values.values()):
            return ""
        for example in batch:
            leaves = {name: value.detach().clone().requires_grad_() for name, value in values.items()}
            loss = self._family.loss(leaves, [example], softness).sum()
            if loss.requires_grad:
                loss.backward()
            for name, value in leaves.items():
                if value.grad is not None and not bool(torch.isfinite(value.grad).all()):
                    where = f"{example.clip}, frame {example.frame}"
                    return f"the gradient of the loss in {name} = {float(value.detach()):.6g} is not finite for {where}"
        return ""


def split_examples(examples: Sequence[Example], watched: float, most: int) -> tuple[list[Example], list[Example]]:
    """Return the examples to learn from, and the examples to watch: the last examples of each clip.

    A clip with three or more examples has at least one example of each kind. most: largest number to watch, chosen
    evenly. Neighbouring frames are similar, so a contiguous part is a better test than single frames. If no clip has
    three examples, or watched is 0, all examples serve for both.
    """
    clips: dict[str, list[Example]] = {}
    for example in examples:
        clips.setdefault(example.clip, []).append(example)
    learned, kept = list[Example](), list[Example]()
    for mine in clips.values():
        count = min(max(1, round(watched * len(mine))), len(mine) - 1) if watched and len(mine) >= 3 else 0
        learned += mine[: len(mine) - count]
        kept += mine[len(mine) - count :]
    kept = kept or learned
    if len(kept) > most:
        kept = [kept[i * len(kept) // most] for i in range(most)]
    return learned, kept


def draw_batch(step: int, clips: Sequence[str], batch: int, seed: int) -> list[int]:
    """Return the indices of the examples of a step, counted from 0. clips: the clip of each example.

    A round takes all examples in a random order, and repeats those of clips with fewer examples, so that all clips
    weigh the same. The next round draws a new order. The arguments alone determine the result, so that descents can be
    resumed.
    """
    batch = min(batch, len(clips))
    of_clip: dict[str, list[int]] = {}
    for place, clip in enumerate(clips):
        of_clip.setdefault(clip, []).append(place)
    most = max(len(places) for places in of_clip.values())

    def draw_order(turn: int) -> list[int]:
        """Return one round: each clip has as many examples as the largest clip."""
        generator = torch.Generator().manual_seed((seed * 1_000_003 + turn) % 2**63)
        drawn: list[int] = []
        for places in of_clip.values():
            rounds = [torch.randperm(len(places), generator=generator) for _ in range(-(-most // len(places)))]
            drawn += [places[i] for i in torch.cat(rounds)[:most].tolist()]
        return [drawn[i] for i in torch.randperm(len(drawn), generator=generator).tolist()]

    first, count = step * batch, len(of_clip) * most
    turns = range(first // count, (first + batch - 1) // count + 1)
    order = [place for turn in turns for place in draw_order(turn)]
    return order[first - turns[0] * count :][:batch]


def clip_shares(clips: Sequence[str]) -> list[float]:
    """Return the weight of each example in a mean with equal weights for all clips. clips: the clip of each example."""
    count = Counter(clips)
    return [1 / (len(count) * count[clip]) for clip in clips]
