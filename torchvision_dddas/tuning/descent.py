"""Gradient descent on parameters: Adam, annealed softness, early stopping on watched examples."""

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor

from torchvision_dddas.config import Settings
from torchvision_dddas.errors import InputError
from torchvision_dddas.tuning import checkpoint
from torchvision_dddas.tuning.examples import clip_shares, draw_batch, split_examples
from torchvision_dddas.tuning.family import Example, Family
from torchvision_dddas.tuning.parameters import TUNABLE, Parameters

FINAL_RATE = 0.1
"""The rate at the last step, as a share of the first."""

SIZES_FIXED = 0.5
"""After this share of the steps sizes are whole numbers and only the other parameters move, if there are such."""

GAIN = 1e-5
"""A loss that is less by no more than this is rounding, and no reason to move a parameter."""


@dataclass(frozen=True)
class Plan:
    """How to descend. rate: of Adam, in units of which one is about a factor e of a parameter.

    look_every: steps between two measurements of the watched examples. patience: measurements without a gain that end
    the descent. watched: share of each clip's examples, its last, that is held back for this. most_watched: of all
    clips together. most_s: no step begins after this many seconds. pull: weight of half the squared distance from the
    start in the loss, in the rate's units; it keeps parameters in place that few examples determine weakly.
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
        """Raises InputError for a value out of its range."""
        for name in ("steps", "batch", "look_every", "patience", "most_watched"):
            if getattr(self, name) < 1:
                raise InputError(f"{name} must be 1 or more, got {getattr(self, name)}")
        if not 0 < self.rate <= 10:
            raise InputError(f"rate must be more than 0 and at most 10, got {self.rate:g}")
        if not 0 <= self.watched <= 0.9:
            raise InputError(f"watched must be between 0 and 0.9, got {self.watched:g}")
        if not 0 <= self.pull < math.inf:
            raise InputError(f"pull must be 0 or more, got {self.pull:g}")


class Cost(Protocol):
    """A charge for time: see `time_cost`."""

    def term(self, parameters: Mapping[str, Tensor]) -> Tensor:
        """To be added to a loss: a tensor without axes."""
        ...


@dataclass(frozen=True)
class Step:
    """The parameters after a step, where step 0 is the start, and the losses with the cost.

    loss: of the step's batch, NaN at step 0. watched: mean of the watched examples at the final softness; None where
    they were not measured.
    """

    step: int
    softness: float
    loss: float
    watched: float | None
    parameters: Mapping[str, float]


@dataclass
class Descended:
    """The result of a descent. parameters: in their best state, which is that after step `best`. ended: why.

    failed: in one line, which clip, frame and parameter gave a value that is not finite; empty otherwise. idle:
    parameters without any effect on the loss. taken: steps in `seconds`, without those of a resumed checkpoint.
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
        """The settings of the best state."""
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
    """Move parameters to where the family's loss is least. They are changed in place and end in their best state.

    tell: called with each step, those of a resumed checkpoint included. place: file of a checkpoint, written at every
    measurement. resume: go on from it if it exists. Raises InputError where there are no examples, where no parameter
    has an effect on the loss, where the loss is not finite at the start, and for a checkpoint of another descent.
    """
    plan = plan or Plan()
    if not examples:
        raise InputError(f"there is nothing to tune {family.name} on; give clips with the truth that it needs")
    run = _Run(family, parameters, examples, plan, cost)
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
            run.stop(f"{plan.most_s:g} s are over")
            break
        taken = run.step()
        if taken is not None:
            tell(taken)
        if taken is None or taken.watched is not None:
            run.save(place)
    return run.result(time.perf_counter() - began, resumed)


class _Run:
    """A descent under way."""

    def __init__(
        self, family: Family, parameters: Parameters, examples: Sequence[Example], plan: Plan, cost: Cost | None
    ) -> None:
        self._family, self._parameters, self._plan, self._cost = family, parameters, plan, cost
        self._learned, self._watched = split_examples(examples, plan.watched, plan.most_watched)
        self._clips = [example.clip for example in self._learned]
        self._adam = torch.optim.Adam(parameters.parameters(), lr=plan.rate, betas=(0.9, 0.99))
        self._moved: set[str] = set()
        self._best: dict[str, Tensor] = {}
        self._least, self._best_step, self._since = math.inf, 0, 0
        self._hardest = family.softness[1]
        self.history: list[Step] = []
        self.ended = self.failed = ""

    def begin(self) -> Step:
        """Measure the start."""
        with torch.no_grad():
            values = self._parameters.values()
        if cause := self._blame(self._watched, values, self._hardest):
            raise InputError(f"{cause}, before the first step")
        return self._record(0, self._softness(1), math.nan, measure=True)

    def step(self) -> Step | None:
        """One step; None where it failed."""
        plan, number = self._plan, self.history[-1].step + 1
        softness = self._softness(number)
        batch = [self._learned[i] for i in draw_batch(number - 1, self._clips, plan.batch, plan.seed)]
        has_others = any(TUNABLE[name].rounding == "none" for name in self._moved)
        whole = number > SIZES_FIXED * plan.steps and has_others
        values = self._parameters.values(whole)
        for value in values.values():
            if value.requires_grad:
                value.retain_grad()
        charged = self._family.loss(values, batch, softness).mean() + self._time_term(values)
        loss = charged + self._pull_term(whole)
        if not bool(torch.isfinite(loss)):
            self._fail(number, batch, values, softness)
            return None
        if not (charged.requires_grad or self._moved or self._has_effect(values, softness)):
            raise InputError(f"the loss of {self._family.name} does not depend on {', '.join(self._parameters.names)}")
        self._adam.zero_grad()
        if loss.requires_grad:
            loss.backward()
        if any(value.grad is not None and not bool(torch.isfinite(value.grad).all()) for value in values.values()):
            self._fail(number, batch, values, softness)
            return None
        self._moved |= {name for name, value in values.items() if value.grad is not None and bool(value.grad.any())}
        for group in self._adam.param_groups:
            group["lr"] = plan.rate * (1 - (1 - FINAL_RATE) * (number - 1) / plan.steps)
        self._adam.step()
        is_last = number == plan.steps
        step = self._record(number, softness, float(loss.detach()), is_last or number % plan.look_every == 0)
        if is_last and not self.ended:
            self.ended = f"all {number} steps were taken"
        return None if self.failed else step

    def stop(self, reason: str) -> None:
        """End here, with a measurement of the last state."""
        last = self.history[-1]
        if last.watched is None:
            self.history.pop()
            self._record(last.step, last.softness, last.loss, measure=True)
        self.ended = self.ended or reason

    def load(self, place: Path) -> None:
        """Take up a checkpoint. Raises InputError for one of another descent."""
        state = checkpoint.read_checkpoint(place, self._facts())
        self._parameters.load_state_dict(state["knobs"])
        self._adam.load_state_dict(state["adam"])
        self._best, self._least, self._best_step = state["best"], state["least"], state["best_step"]
        self._since, self._moved = state["since"], set(state["moved"])
        self.history = [Step(**step) for step in state["history"]]
        self.ended, self.failed = state["ended"], state["failed"]

    def save(self, place: Path | None) -> None:
        """Write a checkpoint. Raises InputError where the disk refuses."""
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
        checkpoint.write_checkpoint(place, self._facts(), state)

    def result(self, seconds: float, resumed: int) -> Descended:
        """The parameters in their best state, and how they got there."""
        self._parameters.load_state_dict(self._best)
        names = self._parameters.names if len(self.history) > 1 else []
        return Descended(
            self._parameters,
            self._best_step,
            self.history,
            self.ended or "a loss was not finite",
            self.failed,
            seconds,
            tuple(name for name in names if name not in self._moved),
            self.history[-1].step - resumed,
        )

    def _record(self, number: int, softness: float, loss: float, measure: bool) -> Step:
        """Note the parameters as they are now; measure: and the loss of the watched examples."""
        watched = None
        with torch.no_grad():
            values = self._parameters.values()
            if measure:
                # Rounded as the settings are: a blend of two sizes may do well where either alone does badly.
                settled = self._parameters.settled()
                watched = self._watched_mean(settled)
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

    def _watched_mean(self, values: Mapping[str, Tensor]) -> float:
        """The mean loss of the watched examples at the final softness, every clip with the same weight, charged."""
        shares = iter(clip_shares([example.clip for example in self._watched]))
        losses = (self._family.loss(values, part, self._hardest).tolist() for part in self._parts(self._watched))
        # Each part is summed exactly, so that the result does not depend on the order within it.
        total = sum(math.fsum(loss * next(shares) for loss in part) for part in losses)
        return total + float(self._time_term(values) + self._pull_term())

    def _time_term(self, values: Mapping[str, Tensor]) -> Tensor:
        return torch.zeros((), dtype=torch.float64) if self._cost is None else self._cost.term(values)

    def _pull_term(self, whole: bool = False) -> Tensor:
        if not self._plan.pull:
            return torch.zeros((), dtype=torch.float64)
        return self._plan.pull / 2 * self._parameters.moved(whole)

    def _has_effect(self, values: Mapping[str, Tensor], softness: float) -> bool:
        """Whether any example depends on a parameter, as those of one batch may not."""
        return any(self._family.loss(values, part, softness).requires_grad for part in self._parts(self._learned))

    def _parts(self, examples: Sequence[Example]) -> Iterator[Sequence[Example]]:
        return (examples[i : i + self._plan.batch] for i in range(0, len(examples), self._plan.batch))

    def _fail(self, number: int, batch: Sequence[Example], values: Mapping[str, Tensor], softness: float) -> None:
        self.failed = f"{self._blame(batch, values, softness) or 'the cost is not finite'}, at step {number}"

    def _blame(self, batch: Sequence[Example], values: Mapping[str, Tensor], softness: float) -> str:
        known = [self.history[i].parameters for i in (-1, self._best_step, 0)] if self.history else []
        before = [{name: value.new_tensor(of[name]) for name, value in values.items()} for of in known]
        return explain_nonfinite(self._family, batch, values, before, softness, self._plan.batch)

    def _softness(self, number: int) -> float:
        first, last = self._family.softness
        share = (number - 1) / max(self._plan.steps - 1, 1)
        return first ** (1 - share) * last**share if first > 0 and last > 0 else first + (last - first) * share

    def _facts(self) -> dict[str, Any]:
        """What a descent depends on, which a checkpoint must agree with."""
        plan = {name: value for name, value in asdict(self._plan).items() if name != "most_s"}
        seen = [f"{example.clip} {example.frame}" for example in (*self._learned, *self._watched)]
        return checkpoint.describe_descent(self._family, self._parameters, plan, seen, self._cost)


def explain_nonfinite(
    family: Family,
    batch: Sequence[Example],
    values: Mapping[str, Tensor],
    before: Sequence[Mapping[str, Tensor]],
    softness: float,
    size: int = 8,
) -> str:
    """Name the first example whose loss or gradient is not finite, and the parameter; empty where all are finite.

    values: the parameters now; before: at other times, the most similar first. A parameter is named if its earlier
    value alone makes the loss finite, or if its gradient is not finite. size: examples computed at once.
    """
    if all(_is_finite(family, batch[i : i + size], values, softness) for i in range(0, len(batch), size)):
        return _explain_gradient(family, batch, values, softness)
    example = next((one for one in batch if not _is_finite(family, [one], values, softness)), None)
    if example is None:
        return (
            f"the loss of {family.name} is not finite for {batch[0].clip}, frame {batch[0].frame} and those beside it"
        )
    where = f"the loss of {family.name} is not finite for {example.clip}, frame {example.frame}"
    good = next((known for known in before if _is_finite(family, [example], known, softness)), None)
    if good is None:
        return f"{where}, whatever the parameters"
    guilty = [name for name in values if _is_finite(family, [example], {**values, name: good[name]}, softness)]
    return f"{where}, with {', '.join(f'{name} = {float(values[name].detach()):.6g}' for name in guilty or values)}"


def _explain_gradient(family: Family, batch: Sequence[Example], values: Mapping[str, Tensor], softness: float) -> str:
    if not any(value.requires_grad for value in values.values()):
        return ""
    for example in batch:
        leaves = {name: value.detach().clone().requires_grad_() for name, value in values.items()}
        loss = family.loss(leaves, [example], softness).sum()
        if not loss.requires_grad:
            continue
        gradients = torch.autograd.grad(loss, list(leaves.values()), allow_unused=True)
        for (name, value), gradient in zip(leaves.items(), gradients, strict=True):
            if gradient is not None and not bool(torch.isfinite(gradient).all()):
                where = f"{example.clip}, frame {example.frame}"
                return f"the gradient of the loss in {name} = {float(value.detach()):.6g} is not finite for {where}"
    return ""


def _is_finite(family: Family, batch: Sequence[Example], values: Mapping[str, Tensor], softness: float) -> bool:
    with torch.no_grad():
        return bool(torch.isfinite(family.loss(values, batch, softness)).all())
