"""Gradient descent on parameters: Adam, annealed softness, early stopping on watched examples."""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor

from torchvision_dddas.config import Settings
from torchvision_dddas.errors import InputError
from torchvision_dddas.tuning import checkpoint
from torchvision_dddas.tuning.examples import batch_of, parted, shares
from torchvision_dddas.tuning.family import Example, Family
from torchvision_dddas.tuning.parameters import TUNABLE, Parameters

FADED = 0.1
"""Of the rate, at the last step."""

SIZED = 0.5
"""Of the steps: after them sizes are whole, and what is no size follows; where such has no say, sizes go on."""

GAIN = 1e-5
"""A loss that is less by no more than this is rounding, and no reason to move a parameter."""


@dataclass(frozen=True)
class Plan:
    """How to descend. rate: of Adam, in units of which one is about a factor e of a parameter.

    look_every: steps from one look at the watched examples to the next. patience: looks without a gain that end the
    descent. watched: share of each clip's examples, its last, that nothing is learned from. most_watched: of all clips
    together. most_s: no step is begun after so many seconds. pull: towards the knobs' values before the first step; a
    loss is charged half of it times the square of how far each parameter is from there, in the rate's units: what few
    examples say weakly does not move a parameter far.
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
        """Raises InputError for what will not do."""
        for name in ("steps", "batch", "look_every", "patience", "most_watched"):
            if getattr(self, name) < 1:
                raise InputError(f"{name.replace('_', ' ')} is {getattr(self, name)}; wanted 1 or more")
        if not 0 < self.rate <= 10:
            raise InputError(f"the rate is {self.rate:g}; wanted more than 0, at most 10")
        if not 0 <= self.watched <= 0.9:
            raise InputError(f"the share of examples to watch is {self.watched:g}; wanted 0 to 0.9")
        if not 0 <= self.pull < math.inf:
            raise InputError(f"the pull is {self.pull:g}; wanted 0 or more")


class Cost(Protocol):
    """What a loss is charged for time: see `costing`."""

    def term(self, parameters: Mapping[str, Tensor]) -> Tensor:
        """To be added to a loss, a number without axes."""
        ...


@dataclass(frozen=True)
class Step:
    """The parameters after a step, of which 0 is before the first, and the losses, which hold the cost.

    loss: of the step's batch, NaN at step 0. watched: the mean of the watched examples, as hard as at the last step;
    None where they were not looked at.
    """

    step: int
    softness: float
    loss: float
    watched: float | None
    parameters: Mapping[str, float]


@dataclass
class Descended:
    """What became of it. parameters: in their best state, which is that after step `best`. ended: why, in words.

    failed: in a line, which clip, frame and parameter gave no number; empty where all went well. taken: steps in
    `seconds`, without those that a checkpoint held.
    """

    parameters: Parameters
    best: int
    history: list[Step] = field(default_factory=list)
    ended: str = ""
    failed: str = ""
    seconds: float = 0.0
    idle: tuple[str, ...] = ()
    taken: int = 0

    @property
    def settings(self) -> Settings:
        """The settings of the best state, as every command takes them."""
        return self.parameters.settings()


def descend(
    family: Family,
    parameters: Parameters,
    examples: Sequence[Example],
    plan: Plan | None = None,
    cost: Cost | None = None,
    tell: Callable[[Step], object] = lambda step: None,
    place: Path | None = None,
    resume: bool = False,
) -> Descended:
    """Move knobs to where the family's loss is least. The knobs that are given are moved, and end in their best state.

    place: the file of a checkpoint, written at every look. resume: go on from it if it is there; tell is then called
    for the steps that it holds too. Raises InputError where there are no examples, where no parameter has a say in the
    loss, where the loss is no number before the first step, and for a checkpoint of another descent.
    """
    plan = plan or Plan()
    if not examples:
        raise InputError(f"there is nothing to tune {family.name} on; wanted clips with truth that it can learn from")
    run = _Run(family, parameters, examples, plan, cost)
    began = time.perf_counter()
    if resume and place is not None and place.is_file():
        run.load(place)
    held = run.history[-1].step if run.history else 0
    for known in run.history:
        tell(known)
    if not run.history:
        tell(run.begin())
        run.save(place)
    while not (run.ended or run.failed):
        if time.perf_counter() - began >= plan.most_s:
            run.ended = f"{plan.most_s:g} s are over"
            run.look()
            break
        step = run.step()
        if step is not None:
            tell(step)
        if step is None or step.watched is not None:
            run.save(place)
    return run.result(time.perf_counter() - began, held)


class _Run:
    """A descent under way."""

    def __init__(
        self, family: Family, parameters: Parameters, examples: Sequence[Example], plan: Plan, cost: Cost | None
    ) -> None:
        self._family, self._parameters, self._plan, self._cost = family, parameters, plan, cost
        self._learned, self._watched = parted(examples, plan.watched, plan.most_watched)
        self._clips = [example.clip for example in self._learned]
        self._adam = torch.optim.Adam(parameters.parameters(), lr=plan.rate, betas=(0.9, 0.99))
        self._moved: set[str] = set()
        self._best: dict[str, Tensor] = {}
        self._least, self._best_step, self._since = math.inf, 0, 0
        self.history: list[Step] = []
        self.ended = self.failed = ""

    def begin(self) -> Step:
        """Look before the first step."""
        with torch.no_grad():
            values = self._parameters.values()
        if cause := self._unfit(self._watched, values, self._hardest):
            raise InputError(f"{cause}, before the first step")
        return self._told(0, self._softness(1), math.nan, look=True)

    def step(self) -> Step | None:
        """One step; None where it could not be taken."""
        number = self.history[-1].step + 1
        softness = self._softness(number)
        batch = [self._learned[i] for i in batch_of(number - 1, self._clips, self._plan.batch, self._plan.seed)]
        follow = any(TUNABLE[name].rounding == "none" for name in self._moved)
        whole = number > SIZED * self._plan.steps and follow
        values = self._parameters.values(whole)
        for value in values.values():
            if value.requires_grad:
                value.retain_grad()
        losses = self._family.loss(values, batch, softness)
        charged = losses.mean() + self._price(values)
        loss = charged + self._pull(whole)
        if not bool(torch.isfinite(loss)):
            self._fail(number, batch, values, softness)
            return None
        if not (charged.requires_grad or self._moved or self._heard(values, softness)):
            raise InputError(f"the loss of {self._family.name} does not depend on {', '.join(self._parameters.names)}")
        self._adam.zero_grad()
        if loss.requires_grad:
            loss.backward()
        if any(value.grad is not None and not bool(torch.isfinite(value.grad).all()) for value in values.values()):
            self._fail(number, batch, values, softness)
            return None
        self._moved |= {name for name, value in values.items() if value.grad is not None and bool(value.grad.any())}
        for group in self._adam.param_groups:
            group["lr"] = self._plan.rate * (1 - (1 - FADED) * (number - 1) / self._plan.steps)
        self._adam.step()
        last = number == self._plan.steps
        told = self._told(number, softness, float(loss.detach()), last or number % self._plan.look_every == 0)
        if last and not self.ended:
            self.ended = f"all {number} steps were taken"
        return None if self.failed else told

    def look(self) -> None:
        """Look at the state after the last step, where that was not done."""
        last = self.history[-1]
        if last.watched is None:
            self.history.pop()
            ended, self.ended = self.ended, ""
            self._told(last.step, last.softness, last.loss, look=True)
            self.ended = self.ended or ended

    def load(self, place: Path) -> None:
        """Take up what a checkpoint holds. Raises InputError for one of another descent."""
        state = checkpoint.read(place, self._facts())
        self._parameters.load_state_dict(state["knobs"])
        self._adam.load_state_dict(state["adam"])
        self._best, self._least, self._best_step = state["best"], state["least"], state["best_step"]
        self._since, self._moved = state["since"], set(state["moved"])
        self.history = [Step(**step) for step in state["history"]]
        self.ended, self.failed = state["ended"], state["failed"]

    def save(self, place: Path | None) -> None:
        """Write a checkpoint, whole or not at all. Raises InputError where the disk refuses."""
        if place is None:
            return
        state = {
            "knobs": self._parameters.state_dict(),
            "adam": self._adam.state_dict(),
            "best": self._best,
            "least": self._least,
            "best_step": self._best_step,
            "since": self._since,
            "moved": sorted(self._moved),
            "history": [asdict(step) for step in self.history],
            "ended": self.ended,
            "failed": self.failed,
        }
        checkpoint.write(place, self._facts(), state)

    def result(self, seconds: float, held: int) -> Descended:
        """The parameters in their best state, and how they came there."""
        self._parameters.load_state_dict(self._best)
        ended = self.ended or "a loss was no number"
        idle = (
            tuple(name for name in self._parameters.names if name not in self._moved) if len(self.history) > 1 else ()
        )
        taken = self.history[-1].step - held
        return Descended(self._parameters, self._best_step, self.history, ended, self.failed, seconds, idle, taken)

    def _told(self, number: int, softness: float, loss: float, look: bool) -> Step:
        """Take note of the parameters as they are now, and where they are looked at of how good they are."""
        with torch.no_grad():
            values = self._parameters.values()
            # Rounded as settings are: between whole sizes a blend may do well, and either of them badly.
            settled = self._parameters.settled() if look else {}
            watched = self._mean(settled) if look else None
        if watched is not None and not math.isfinite(watched):
            self._fail(number, self._watched, settled, self._hardest)
            watched = None
        step = Step(number, softness, loss, watched, {name: float(value) for name, value in values.items()})
        if watched is not None:
            self._judge(number, watched)
        if not self.failed:
            self.history.append(step)
        return step

    def _judge(self, number: int, watched: float) -> None:
        if not self._best or watched < self._least - GAIN:
            self._least, self._best_step, self._since = watched, number, 0
            self._best = {name: value.clone() for name, value in self._parameters.state_dict().items()}
            return
        self._since += 1
        if self._since >= self._plan.patience:
            self.ended = f"no gain on the watched examples since step {self._best_step}"

    def _mean(self, values: Mapping[str, Tensor]) -> float:
        """The mean loss of the watched examples, every clip with the same say, as hard as at the last step, charged."""
        size, total = self._plan.batch, 0.0
        share = shares([example.clip for example in self._watched])
        for i in range(0, len(self._watched), size):
            losses = self._family.loss(values, self._watched[i : i + size], self._hardest)
            total += math.fsum(loss * part for loss, part in zip(losses.tolist(), share[i : i + size], strict=True))
        return total + float(self._price(values) + self._pull())

    def _price(self, values: Mapping[str, Tensor]) -> Tensor:
        """For time."""
        return torch.zeros((), dtype=torch.float64) if self._cost is None else self._cost.term(values)

    def _pull(self, whole: bool = False) -> Tensor:
        """For what the parameters are away from where they began; whole: sizes stay where they are."""
        if not self._plan.pull:
            return torch.zeros((), dtype=torch.float64)
        return self._plan.pull / 2 * self._parameters.moved(whole)

    def _heard(self, values: Mapping[str, Tensor], softness: float) -> bool:
        """Whether any example that is learned from depends on a parameter; that of one batch may not."""
        size = self._plan.batch
        parts = (self._learned[i : i + size] for i in range(0, len(self._learned), size))
        return any(self._family.loss(values, part, softness).requires_grad for part in parts)

    def _fail(self, number: int, batch: Sequence[Example], values: Mapping[str, Tensor], softness: float) -> None:
        self.failed = f"{self._unfit(batch, values, softness) or 'the cost is no number'}, at step {number}"

    def _unfit(self, batch: Sequence[Example], values: Mapping[str, Tensor], softness: float) -> str:
        known = [self.history[i].parameters for i in (-1, self._best_step, 0)] if self.history else []
        before = [{name: value.new_tensor(of[name]) for name, value in values.items()} for of in known]
        return blamed(self._family, batch, values, before, softness, self._plan.batch)

    @property
    def _hardest(self) -> float:
        return self._family.softness[1]

    def _softness(self, number: int) -> float:
        first, last = self._family.softness
        share = (number - 1) / max(self._plan.steps - 1, 1)
        return first ** (1 - share) * last**share if first > 0 and last > 0 else first + (last - first) * share

    def _facts(self) -> dict[str, Any]:
        """What a descent depends on: of a checkpoint it has to be the same."""
        plan = {name: value for name, value in asdict(self._plan).items() if name != "most_s"}
        seen = [f"{example.clip} {example.frame}" for example in (*self._learned, *self._watched)]
        return checkpoint.facts(self._family, self._parameters, plan, seen, self._cost)


def blamed(
    family: Family,
    batch: Sequence[Example],
    values: Mapping[str, Tensor],
    before: Sequence[Mapping[str, Tensor]],
    softness: float,
    size: int = 8,
) -> str:
    """In words, the first example whose loss or slope is no number, and the parameter; empty where all are numbers.

    values: the parameters now; before: as they were at other times, those that are most like now first. A parameter is
    to blame whose value alone, taken back, makes the loss a number, or whose slope is none. size: examples at once.
    """
    if all(_finite(family, batch[i : i + size], values, softness) for i in range(0, len(batch), size)):
        return _by_slope(family, batch, values, softness)
    example = next((one for one in batch if not _finite(family, [one], values, softness)), None)
    if example is None:
        return f"the loss of {family.name} is no number for {batch[0].clip}, frame {batch[0].frame} and those beside it"
    where = f"the loss of {family.name} is no number for {example.clip}, frame {example.frame}"
    good = next((known for known in before if _finite(family, [example], known, softness)), None)
    if good is None:
        return f"{where}, whatever the parameters"
    guilty = [name for name in values if _finite(family, [example], {**values, name: good[name]}, softness)]
    told = ", ".join(f"{name} = {float(values[name].detach()):.6g}" for name in guilty or values)
    return f"{where}, with {told}"


def _by_slope(family: Family, batch: Sequence[Example], values: Mapping[str, Tensor], softness: float) -> str:
    if not any(value.requires_grad for value in values.values()):
        return ""
    for example in batch:
        leaves = {name: value.detach().clone().requires_grad_() for name, value in values.items()}
        loss = family.loss(leaves, [example], softness).sum()
        if not loss.requires_grad:
            continue
        slopes = torch.autograd.grad(loss, list(leaves.values()), allow_unused=True)
        for (name, value), slope in zip(leaves.items(), slopes, strict=True):
            if slope is not None and not bool(torch.isfinite(slope).all()):
                where = f"{example.clip}, frame {example.frame}"
                return f"the slope of the loss in {name} = {float(value.detach()):.6g} is no number for {where}"
    return ""


def _finite(family: Family, batch: Sequence[Example], values: Mapping[str, Tensor], softness: float) -> bool:
    with torch.no_grad():
        return bool(torch.isfinite(family.loss(values, batch, softness)).all())
