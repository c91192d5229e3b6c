"""Fly a scenario in the closed loop: simulated vehicles, the pipeline that steers them, the files and the score."""

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from pathlib import Path
from typing import Any

from torchvision_dddas import geometry
from torchvision_dddas.config import load_config
from torchvision_dddas.control import Mission, StartedSource
from torchvision_dddas.errors import InputError
from torchvision_dddas.geo import Zones
from torchvision_dddas.io.output import NOTICED, RunRecord, clip_facts
from torchvision_dddas.lab.evaluation.metrics.crowds import CrowdScore, CrowdScorer
from torchvision_dddas.lab.simulation import (
    SimulatedRunRecorder,
    SimulatorSource,
    load_scenario,
    name_scenario_in_errors,
    scenario_settings,
)
from torchvision_dddas.pipeline import Pipeline, assemble_mission, map_site


def run_scenario(
    folder: Path,
    scenario: str,
    config: str | None = None,
    overrides: Sequence[str] = (),
    scene: Sequence[str] = (),
    seed: int | None = None,
    backend: str = "auto",
    save: Sequence[str] = (),
    progress: Callable[[str, int | None], AbstractContextManager[Callable[[], None]]] | None = None,
    zones: Zones | None = None,
) -> tuple[RunRecord, CrowdScore]:
    """Fly a scenario, write all files into a folder, and return the record of the run and its score.

    zones: zones whose events are also written. overrides: changes of the settings. scene: changes of the scenario.
    progress: takes a name and the number of frames, and returns a context with a function to call for each frame. Raise
    InputError for bad input.
    """
    with SimulatedRunRecorder(folder, save) as output:
        chosen = load_scenario(scenario, scene, seed)
        if chosen.clip.located_by == "nothing":
            raise InputError(
                f"scenario {scenario} has clip.located_by = nothing, so that vehicles cannot be steered; add "
                "--scene clip.located_by='telemetry', or make files of it with `dddas simulate`"
            )
        own = scenario_settings(chosen, config)
        own.setdefault("landmarks.common_sigma_m", chosen.gps.common_m)
        settings = load_config(config, overrides, base=own)
        with name_scenario_in_errors(scenario):
            simulated = SimulatorSource(chosen, Path(scenario).stem)
        source: Any = StartedSource(simulated)
        ready = assemble_mission(source, settings, backend, chosen.clip.located_by == "landmarks")
        mission = ready.mission
        assert mission is not None
        locator = mission.watch.locator
        facts: dict[str, Any] = {
            "input": f"sim:{simulated.name}",
            "clip": clip_facts(simulated),
            "scenario": chosen.model_dump(),
            "backend": ready.engine.name,
            "origin_deg": locator.site.origin_deg,
            "settings": mission.settings.model_dump(),
        }
        record = output.begin(
            facts, simulated.rate_hz, simulated.size, map_site(locator, None), zones.zones if zones else ()
        )
        output.record_truth(partial(geometry.lonlat, origin_deg=simulated.origin_deg))
        scorer = CrowdScorer(partial(geometry.east_north, origin_deg=simulated.origin_deg))
        try:
            with (progress or _no_progress)(simulated.name, simulated.count) as tick:
                done = 0
                results = Pipeline.from_assembly(ready)(source)
                for result in results if zones is None else zones.mark(results):
                    for truth in simulated.truths():
                        scorer.feed(truth)
                        output.add_truth(truth)
                        for event in truth.events:
                            output.story.event(truth.frame, event, truth.time_s)
                    _log_notices(output, mission)
                    scorer.feed(result)
                    output.write(result)
                    for _ in range(result.tracked.number - done):
                        tick()
                    done = result.tracked.number
        finally:
            _log_notices(output, mission)
            record.notes += zones.notes if zones else []
            record.problems += [str(problem) for problem in simulated.problems]
            for problem in simulated.problems:
                output.story.event(problem.frame, str(problem), kind="problem")
        score = scorer.score()
        output.story.score(score.by_name(), score.lines())
    return record, score


def _no_progress(name: str, count: int | None) -> AbstractContextManager[Callable[[], None]]:
    return nullcontext(lambda: None)


def _log_notices(output: SimulatedRunRecorder, mission: Mission) -> None:
    """Log problems that the run itself noticed."""
    for notice in mission.notices():
        output.story.event(notice.frame, notice.text, notice.time_s, NOTICED)
