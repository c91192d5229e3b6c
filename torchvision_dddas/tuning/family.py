"""Families of parameters that can be tuned by gradient, and the preparation of a study for them."""

import glob
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from torch import Tensor

from torchvision_dddas.config import Settings, load_config
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.record import Clip
from torchvision_dddas.evaluation.studies.goals import Goal, check_possible, parse_goal
from torchvision_dddas.evaluation.studies.runner import plan_study
from torchvision_dddas.evaluation.studies.spec import Spec, Task
from torchvision_dddas.evaluation.studies.sweep import split_clips
from torchvision_dddas.tuning.parameters import TUNABLE, Parameters, chosen

Tick = Callable[[], object]

FAMILIES: Mapping[str, str] = {
    "motion": "motion",
    "registration": "registration",
    "tracking": "tracking",
    "paper": "source_association",
    "people": "people",
    "location": "places",
}
"""Family, as `modules.tunable` names it -> the module of this folder whose function `family()` makes it."""


@dataclass(frozen=True)
class Example:
    """One piece of what is true. clip, frame: what messages name. content: what the family's loss takes, on the CPU."""

    clip: str
    frame: int
    content: Any


class Family(Protocol):
    """A stage of the pipeline, as far as it can be tuned."""

    @property
    def name(self) -> str:
        """One of FAMILIES."""
        ...

    @property
    def task(self) -> Task:
        """The task of a study that its knobs matter for: its clips are tuned on, and it measures before and after."""
        ...

    @property
    def measure(self) -> str:
        """What is told before and after, as `dddas sweep --measure` takes it: motion.pixels.f. Hard operations."""
        ...

    @property
    def softness(self) -> tuple[float, float]:
        """At the first and the last step; the steps between go evenly in the logarithm. No unit: 1 is very soft."""
        ...

    def examples(self, clips: Sequence[Clip], settings: Settings, tick: Tick = lambda: None) -> list[Example]:
        """What is true of some clips, each clip's in the order of its frames, prepared once by the hard operations.

        tick: called once an example. Raises InputError in one line where a clip lacks the truth that the loss needs.
        """
        ...

    def loss(self, parameters: Mapping[str, Tensor], batch: Sequence[Example], softness: float) -> Tensor:
        """How wrong each example is: (B,), least is best, with a gradient in the parameters; on the knobs' device.

        parameters: values in the units of `settings`, scalars or (n,), by name: those tuned alone; what is not tuned is
        as in the settings that the examples were prepared with. The result depends on nothing but the arguments.
        """
        ...


@runtime_checkable
class Timed(Protocol):
    """A family whose examples depend on how far apart the looks are."""

    def at(self, interval_frames: int, task: Task) -> Family:
        """The family for a study's interval and for the task that its measure is of."""
        ...


@runtime_checkable
class Particular(Protocol):
    """A family whose parameters have a say under some settings alone."""

    def check(self, names: Sequence[str], settings: Settings) -> None:
        """Raises InputError in one line, with what to set, where one of its parameters would be tuned for nothing."""
        ...


@runtime_checkable
class Choosing(Protocol):
    """A family that offers several losses."""

    @property
    def losses(self) -> tuple[str, ...]:
        """Their names, the first the one that is taken unless said."""
        ...

    @property
    def loss_name(self) -> str:
        """The one that is taken."""
        ...

    def by(self, loss_name: str) -> Family:
        """The family with one of its losses."""
        ...


def with_loss(family: Family, name: str) -> Family:
    """A family with one of its losses. Raises InputError, with what there is, where it has no such."""
    offered = family.losses if isinstance(family, Choosing) else ()
    if isinstance(family, Choosing) and name in offered:
        return family.by(name)
    there = f"wanted one of {', '.join(offered)}" if offered else "it has one of its own; leave --loss out"
    raise InputError(f"'{name}' is no loss of the family {family.name}; {there}")


def loss_of(family: Family) -> str:
    """The name of a family's loss; empty where it has no choice."""
    return family.loss_name if isinstance(family, Choosing) else ""


def family_of(name: str) -> Family:
    """The family of a name. Raises InputError where there is none."""
    module = f"{__package__}.{FAMILIES[name]}" if name in FAMILIES else ""
    if not module or find_spec(module) is None:
        known = [known for known, file in FAMILIES.items() if find_spec(f"{__package__}.{file}") is not None]
        raise InputError(f"'{name}' is no family of parameters that can be tuned; wanted one of {', '.join(known)}")
    found: Family = import_module(module).family()
    return found


@dataclass
class Prepared:
    """What there is to tune. spec: the study with the family's task alone. tuned, held: names of clips.

    clips: those tuned on. goal: what is told before and after.
    """

    spec: Spec
    base: Path
    family: Family
    parameters: Parameters
    clips: tuple[Clip, ...]
    tuned: tuple[str, ...]
    held: tuple[str, ...]
    goal: Goal
    examples: list[Example]


def prepare(
    spec: Spec,
    base: Path,
    names: Sequence[str],
    holdout: Sequence[str] = (),
    clips: Sequence[str] = (),
    measure: str | None = None,
    loss: str | None = None,
    tick: Tick = lambda: None,
) -> Prepared:
    """Read a study's clips, and prepare the examples of those that are not held out.

    names: of parameters, as `tunable.chosen` takes them. holdout, clips: patterns of clips' names. measure: in place of
    the family's. loss: one of those that the family offers. tick: called once an example. Raises InputError for a
    parameter that cannot be tuned or has no say under the settings, parameters of several families, a loss that the
    family has not, clips without the truth that is needed, and as `running.plan` does.
    """
    settings = load_config(spec.config, spec.overrides)
    family = _family(names)
    parameters = Parameters(settings, names)
    if isinstance(family, Particular):
        family.check(parameters.names, settings)
    goal = parse_goal(measure or family.measure)
    if isinstance(family, Timed):
        family = family.at(spec.interval, goal.task)
    if loss is not None:
        family = with_loss(family, loss)
    spec = replace(spec, tasks=(goal.task,))
    tuned, held = split_clips(spec, base, clips, holdout)
    seen = tuple(job.clip for job in plan_study(spec, base, [glob.escape(name) for name in tuned]).jobs)
    check_possible(goal, seen)
    examples = family.examples(seen, settings, tick)
    return Prepared(spec, base, family, parameters, seen, tuned, held, goal, examples)


def _family(names: Sequence[str]) -> Family:
    """The one family of all parameters. Raises InputError where they have several."""
    by_family: dict[str, list[str]] = {}
    for name in chosen(names):
        by_family.setdefault(TUNABLE[name].family, []).append(name)
    if len(by_family) > 1:
        told = "; ".join(f"{family}: {', '.join(mine)}" for family, mine in by_family.items())
        raise InputError(
            f"the knobs are of several families, {told}; tune one of them, and then the next with --config tuned.toml"
        )
    return family_of(next(iter(by_family)))
