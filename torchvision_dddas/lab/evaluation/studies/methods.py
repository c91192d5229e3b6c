"""Results of several methods on the same clips. Each method becomes a study, which is compared with the first."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from torchvision_dddas.config import Settings
from torchvision_dddas.errors import InputError
from torchvision_dddas.io.atomic_files import cannot_write, claimed, save_file
from torchvision_dddas.io.output import finite, read_run_record, versions
from torchvision_dddas.lab.evaluation.datasets.record import Clip
from torchvision_dddas.lab.evaluation.evaluate import score_files
from torchvision_dddas.lab.evaluation.metrics.matching import LEAST
from torchvision_dddas.lab.evaluation.metrics.truth import Ignoring, find_truth
from torchvision_dddas.lab.evaluation.report.methods import save_methods
from torchvision_dddas.lab.evaluation.studies.comparison import compare_methods
from torchvision_dddas.lab.evaluation.studies.records import Case, Results, ScoredCase, ScoredStudy, Spec
from torchvision_dddas.lab.evaluation.studies.runner import is_name, write_measures
from torchvision_dddas.lab.evaluation.studies.scoring import by_task


def write_methods(
    folder: Path,
    truth: Path,
    results: Mapping[str, Path],
    *,
    first_frame: int | None = None,
    interval: int = 1,
    ignoring: Ignoring = "dropped",
    least: float = LEAST,
) -> dict[str, Any]:
    """Score the results of methods by name. Write a study of each, and a comparison with the first, into a folder.

    The folder of a method's name holds its study, which `dddas compare` can read. report.html, comparison.json, tables/
    and figures/ show all methods. A clip without a score of every method is left out, with a note. Return the content
    of comparison.json: {"methods": {name: measures}, "comparisons": [as `compare_studies`], "notes": [...]}.
    Raise InputError as `evaluate` does, and if no clip is scored for every method.
    """
    notes: list[str] = []
    with claimed(folder):
        cases = {
            name: _score(name, truth, place, notes, first_frame, interval, ignoring, least)
            for name, place in results.items()
        }
        shared = set.intersection(*({(case.task, case.clip.name) for case in mine} for mine in cases.values()))
        if not shared:
            raise InputError(f"no clip has a score of every method: {', '.join(results)}; do they have the same clips?")
        measures, studies = {}, []
        for name, mine in cases.items():
            alone = [case for case in mine if (case.task, case.clip.name) not in shared]
            notes += [
                f"{case.clip.name}, {case.task}: not scored for every method, left out of {name}" for case in alone
            ]
            kept = Results(Spec(name, ()), Settings(), tuple(case for case in mine if case not in alone))
            try:
                measures[name] = write_measures(folder / name, kept)
            except OSError as error:
                raise cannot_write(folder / name, error) from error
            record = {"state": "complete", "versions": versions(), "result": results[name]}
            settings = (read_run_record(results[name]) or {}).get("settings")
            _write_json(folder / name / "run.json", record | ({"settings": settings} if settings else {}))
            scored = [ScoredCase(c.task, c.clip.name, c.scored) for c in kept.cases if c.scored is not None]
            studies.append(ScoredStudy(name, tuple(scored)))
        comparisons = compare_methods(studies)
        notes += [note for one in comparisons for note in one["notes"]]
        content = {"methods": measures, "comparisons": comparisons, "notes": list(dict.fromkeys(notes))}
        _write_json(folder / "comparison.json", content)
        save_methods(folder, finite(content))
    return content


def name_results(places: Sequence[Path], names: Sequence[str]) -> dict[str, Path]:
    """Return the results by name; by default the names of their files or folders.

    Raise InputError if the numbers of names and results differ, for equal names, and for names that no folder can have.
    """
    names = names or [place.resolve().stem if place.is_file() else place.resolve().name for place in places]
    if len(names) != len(places):
        raise InputError(f"--names has {len(names)} names for {len(places)} results: {', '.join(names)}; give one each")
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"two results are named '{name}'; give each its own name with --names first,second")
        if not is_name(name):
            raise InputError(f"--names: a name must consist of letters, digits, blanks, and . + - _, got {name!r}")
    return dict(zip(names, places, strict=True))


def _score(
    method: str,
    truth: Path,
    result: Path,
    notes: list[str],
    first_frame: int | None,
    interval: int,
    ignoring: Ignoring,
    least: float,
) -> list[Case]:
    """Return the cases of a method. A single clip gets the truth's name, because its file has the method's name."""
    own: list[str] = []
    scored = score_files(truth, result, own, first_frame, interval, ignoring, least)
    notes += [f"{method}: {note}" for note in own]
    if find_truth(truth) is not None:
        scored = {_clip_name(truth): next(iter(scored.values()))}
    return [
        Case(Clip(name, truth), task, scored=found)
        for name, clip in sorted(scored.items())
        for task, found in by_task(clip, interval).items()
    ]


def _clip_name(truth: Path) -> str:
    place = truth.resolve()
    place = place if place.is_dir() else place.parent
    return (place.parent if place.name == "gt" else place).name or "clip"


def _write_json(path: Path, content: Any) -> None:
    save_file(path, (json.dumps(finite(content), indent=2) + "\n").encode())
