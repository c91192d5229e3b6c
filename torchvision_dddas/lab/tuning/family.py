"""Families of tunable parameters: their base class, and the preparation of a study for one of them."""

import glob
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib import import_module
from pathlib import Path
from typing import Any, Self

from torch import Tensor

from torchvision_dddas.config import Settings, load_config
from torchvision_dddas.errors import InputError
from torchvision_dddas.lab.evaluation.datasets.record import Clip
from torchvision_dddas.lab.evaluation.studies.records import Spec, Task
from torchvision_dddas.lab.evaluation.studies.runner import plan_study
from torchvision_dddas.lab.evaluation.studies.summary import Goal, check_possible, parse_goal
from torchvision_dddas.lab.evaluation.studies.sweep import split_clips
from torchvision_dddas.lab.tuning.parameters import TUNABLE, Parameters, expand_names

Tick = Callable[[], object]

FAMILIES = {
    "motion": "motion.MotionFamily",
    "tracking": "tracking.TrackingFamily",
}
"""Family -> its module and class in this package. The module is loaded when the family is used."""


@dataclass(frozen=True)
class Example:
    """One labelled piece of a clip. clip, frame: names in messages. content: the input of the loss, on the CPU.

    settings: used in its preparation, for parameters that are not tuned; the same for all examples of a descent.
    """

    clip: str
    frame: int
    content: Any
    settings: Settings = field(default_factory=Settings)


class Family(ABC):
    """A stage of the pipeline whose parameters can be tuned: labelled examples, and a loss on them.

    name: a key of FAMILIES. task: the study's task, whose clips are used. measure: compared before and after, such as
    motion.pixels.f. softness: softness of the loss at the first and at the last step. interval: frames between
    examples. empty: reason why a clip may give no example; if it is set, a clip without examples is an error.
    """

    name: str
    task: Task
    measure: str
    softness: tuple[float, float]
    interval: int = 1
    empty = ""

    @abstractmethod
    def clip_examples(self, clip: Clip, settings: Settings) -> Iterable[tuple[int, Any]]:
        """Yield frame number and content of each example of a clip, in the order of its frames.

        Raise InputError if the clip lacks the truth that the loss needs.
        """

    def check(self, names: Sequence[str], settings: Settings) -> None:  # noqa: B027
        """Raise InputError, which says what to set, if a parameter has no effect under these settings."""

    def check_clips(self, clips: Sequence[Clip], settings: Settings) -> None:  # noqa: B027
        """Raise InputError for clips that cannot be used. It is called before any computation."""

    def at(self, interval_frames: int, task: Task) -> Self:
        """Return the family for a study's interval and for the task of the measure."""
        return self

    def examples(self, clips: Sequence[Clip], settings: Settings, tick: Tick = lambda: None) -> list[Example]:
        """Return the examples of all clips. tick: called for each example. Raise InputError for a clip without any."""
        self.check_clips(clips, settings)
        found: list[Example] = []
        for clip in clips:
            before = len(found)
            for frame, content in self.clip_examples(clip, settings):
                found.append(Example(clip.name, frame, content, settings))
                tick()
            if self.empty and len(found) == before:
                raise InputError(f"{clip.name}: {self.empty}")
        return found

    @abstractmethod
    def loss(self, parameters: Mapping[str, Tensor], batch: Sequence[Example], softness: float) -> Tensor:
        """Return the loss of each example, (B,), with a gradient in the parameters, on their device.

        parameters: the tuned values by name, in the units of the settings. All other parameters are as in the
        preparation of the examples. The result depends on nothing else.
        """


def load_family(name: str) -> Family:
    """Return the family of a name. Raise InputError for an unknown name."""
    if name not in FAMILIES:
        raise InputError(f"'{name}' is not a family of tunable parameters; give one of {', '.join(FAMILIES)}")
    module, kind = FAMILIES[name].split(".")
    found: Family = getattr(import_module(f"{__package__}.{module}"), kind)()
    return found


@dataclass
class Prepared:
    """A study that is ready for tuning. spec: the study with only the family's task. tuned, held: names of clips.

    clips: the clips that are used for tuning. goal: the measure that is compared before and after.
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
    tick: Tick = lambda: None,
) -> Prepared:
    """Read a study's clips and prepare the examples of the clips that are not held out.

    names: names of parameters, as for `expand_names`. holdout, clips: patterns of clip names. measure: replaces the
    family's measure. tick: called once for each example. Raise InputError for a parameter that cannot be tuned or has
    no effect under the settings, for parameters of several families, for clips without the needed truth, and as
    `plan_study` does.
    """
    settings = load_config(spec.config, spec.overrides)
    by_family: dict[str, list[str]] = {}
    for name in expand_names(names):
        by_family.setdefault(TUNABLE[name].family, []).append(name)
    if len(by_family) > 1:
        groups = "; ".join(f"{family}: {', '.join(mine)}" for family, mine in by_family.items())
        raise InputError(
            f"the parameters belong to several families, {groups}; tune one family, then the next with --config "
            "tuned.toml"
        )
    family = load_family(*by_family)
    parameters = Parameters(settings, names)
    family.check(parameters.names, settings)
    goal = parse_goal(measure or family.measure)
    family = family.at(spec.interval, goal.task)
    spec = replace(spec, tasks=(goal.task,))
    tuned, held = split_clips(spec, base, clips, holdout)
    used = tuple(job.clip for job in plan_study(spec, base, [glob.escape(name) for name in tuned]).jobs)
    check_possible(goal, used)
    return Prepared(spec, base, family, parameters, used, tuned, held, goal, family.examples(used, settings, tick))
