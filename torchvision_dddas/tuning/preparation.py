"""From a study and names of knobs to what `descent` takes: the family, the knobs, the examples, the clips held out."""

import glob
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from torchvision_dddas.config import load_config
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.record import Clip
from torchvision_dddas.evaluation.studies.goals import Goal, check_possible, goal_of
from torchvision_dddas.evaluation.studies.record import Spec
from torchvision_dddas.evaluation.studies.running import plan
from torchvision_dddas.evaluation.studies.tried import parted
from torchvision_dddas.tuning.family import Example, Family, Particular, Tick, Timed, family_of, with_loss
from torchvision_dddas.tuning.parameters import TUNABLE, Parameters, chosen


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
    goal = goal_of(measure or family.measure)
    if isinstance(family, Timed):
        family = family.at(spec.interval, goal.task)
    if loss is not None:
        family = with_loss(family, loss)
    spec = replace(spec, tasks=(goal.task,))
    tuned, held = parted(spec, base, clips, holdout)
    seen = tuple(job.clip for job in plan(spec, base, [glob.escape(name) for name in tuned]).jobs)
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
