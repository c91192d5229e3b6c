"""`dddas run sim:SCENARIO`: the whole path in a closed loop with simulated vehicles, and what it was worth."""

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from torchvision_dddas.cli.aerial import map_site
from torchvision_dddas.cli.clips import clip_facts
from torchvision_dddas.cli.progress import progress
from torchvision_dddas.errors import InputError

if TYPE_CHECKING:
    from torchvision_dddas.control import Mission
    from torchvision_dddas.evaluation.metrics.crowds import CrowdScore
    from torchvision_dddas.io.output import RunRecord
    from torchvision_dddas.simulation import SimulatedRunRecorder, SimulatorSource

SIMULATED = "sim:"
"""What names of scenarios begin with."""

CONFIG = "patrol"
"""The shipped configuration that a simulated run takes unless another is named."""


def fly(
    scenario: str,
    folder: Path,
    config: str | None,
    overrides: Sequence[str],
    scene: Sequence[str],
    seed: int | None,
    backend: str,
    save: str | None,
    files: Mapping[str, Any],
    quiet: bool,
) -> None:
    """Run a scenario and write everything under a folder. files: options that a scenario has no use for.

    overrides: of the settings; scene: of the scenario. Raises InputError for bad input.
    """
    from torchvision_dddas.cli.run import summary
    from torchvision_dddas.io.output import parse_save
    from torchvision_dddas.simulation import SimulatedRunRecorder

    if useless := [name for name, given in files.items() if given is not None]:
        raise InputError(f"{useless[0]} is of no use with {SIMULATED}{scenario}: the simulated vehicles tell it")
    names = parse_save(save, SimulatedRunRecorder.saved)
    journal, score = fly_into(folder, scenario, config, overrides, scene, seed, backend, names, quiet)
    if not quiet:
        first, *others = summary(journal, folder, True, names)
        for line in (first, *score.lines(), *others):
            typer.echo(line)
        if "truth" in names:
            typer.echo(f"{folder / 'truth'}: what is true; dddas evaluate {folder / 'truth' / 'gt.txt'} {folder}")


def fly_into(
    folder: Path,
    scenario: str,
    config: str | None = None,
    overrides: Sequence[str] = (),
    scene: Sequence[str] = (),
    seed: int | None = None,
    backend: str = "auto",
    save: Sequence[str] = (),
    quiet: bool = False,
) -> "tuple[RunRecord, CrowdScore]":
    """As `fly`, but returns the record of the run and its score, and says nothing at its end."""
    from torchvision_dddas.simulation import SimulatedRunRecorder

    with SimulatedRunRecorder(folder, save) as output:
        from torchvision_dddas import geometry
        from torchvision_dddas.config import load_config
        from torchvision_dddas.control import StartedSource, build_mission
        from torchvision_dddas.detection import load_engine
        from torchvision_dddas.evaluation.metrics.crowds import CrowdScorer
        from torchvision_dddas.pipeline import Pipeline
        from torchvision_dddas.simulation import SimulatorSource, name_scenario_in_errors, scenario_settings
        from torchvision_dddas.simulation import load_scenario as load_scenario

        chosen = load_scenario(scenario, scene, seed)
        if chosen.clip.located_by == "nothing":
            raise InputError(
                f"scenario {scenario} is located by nothing, and where nothing is located nothing can be steered; add "
                "--scene clip.located_by='telemetry', or make files of it with `dddas simulate`"
            )
        own = scenario_settings(chosen)
        own.setdefault("landmarks.common_sigma_m", chosen.gps.common_m)
        settings = load_config(config or CONFIG, overrides, own)
        with name_scenario_in_errors(scenario):
            simulated = SimulatorSource(chosen, Path(scenario).stem)
        source: Any = StartedSource(simulated)
        mission = build_mission(source, settings, backend, chosen.clip.located_by == "landmarks")
        engine = load_engine(backend, mission.settings)
        journal = _begin(output, mission, simulated, engine.name)
        output.record_truth(partial(geometry.lonlat, origin_deg=simulated.origin_deg))
        scorer = CrowdScorer(partial(geometry.east_north, origin_deg=simulated.origin_deg))
        try:
            with progress(simulated.name, simulated.count, quiet) as tick:
                done = 0
                pipeline = Pipeline.from_parts(engine, mission.settings, None, mission.watch, 1, mission)
                for surveyed in pipeline(source):
                    for truth in simulated.truths():
                        scorer.feed(truth)
                        output.add_truth(truth)
                        for event in truth.events:
                            output.story.event(truth.frame, event, truth.time_s)
                    _noticed(output, mission)
                    scorer.feed(surveyed)
                    output.write(surveyed)
                    for _ in range(surveyed.tracked.number - done):
                        tick()
                    done = surveyed.tracked.number
        finally:
            _noticed(output, mission)
            journal.problems += [str(problem) for problem in simulated.problems]
            for problem in simulated.problems:
                output.story.event(problem.frame, str(problem), kind="problem")
        score = scorer.score()
        output.story.score(score.by_name(), score.lines())
    return journal, score


def _noticed(output: "SimulatedRunRecorder", mission: "Mission") -> None:
    """Tell what the run itself saw to go wrong."""
    from torchvision_dddas.io.output import NOTICED

    for notice in mission.notices():
        output.story.event(notice.frame, notice.text, notice.time_s, NOTICED)


def _begin(output: "SimulatedRunRecorder", mission: "Mission", source: "SimulatorSource", backend: str) -> "RunRecord":
    """Say what the run is."""
    locator, site = mission.watch.locator, mission.watch.locator.site
    facts: dict[str, Any] = {
        "input": f"{SIMULATED}{source.name}",
        "clip": clip_facts(source),
        "scenario": source.scenario.model_dump(),
        "backend": backend,
        "origin_deg": site.origin_deg,
        "settings": mission.settings.model_dump(),
    }
    return output.begin(facts, source.rate_hz, source.size, map_site(locator, None))
