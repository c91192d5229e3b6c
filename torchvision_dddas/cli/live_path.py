"""The path of a live run from pictures to results: begun anew after an error, and steered by what it costs."""

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torchvision_dddas.config import Settings
    from torchvision_dddas.io.run_inputs import PreparedRun
    from torchvision_dddas.live import Health, LiveSource
    from torchvision_dddas.live.runner import Feed, Result
    from torchvision_dddas.people import PersonTracker, WindowScorer
    from torchvision_dddas.types import Adjustment, Frame


def path(
    ready: "PreparedRun", source: "LiveSource", people: bool, interval: int, backend: str, health: "Health"
) -> "Callable[[Feed], Iterator[Result]]":
    """What gives results of a feed, anew each time that it is called. Raises InputError at once."""
    from torchvision_dddas.config import with_parameters
    from torchvision_dddas.detection import load_engine
    from torchvision_dddas.live.load_shedding import LoadShedding
    from torchvision_dddas.pipeline import Pipeline

    settings, recognizer = ready.settings, None
    if people:
        from torchvision_dddas.people import load_scorer

        # A look at the whole picture takes as long as many pictures do to come.
        share = min(settings.people.look_share, 0.1)
        settings = with_parameters(settings, {"people.search": "regions", "people.look_share": share})
        recognizer = load_scorer(settings.people, backend)
        _person_tracker(recognizer, settings, interval, source.size)  # refuses pictures that are too small at once
    shedding = LoadShedding(source, settings, health, people)
    visions = iter([ready.engine])

    def begin(feed: "Feed") -> "Iterator[Result]":
        # After an error nothing that remembers a frame is trusted.
        engine = next(visions, None) or load_engine(backend, shedding.settings)
        people_tracker = None
        if recognizer is not None:
            people_tracker = _person_tracker(recognizer, shedding.settings, interval, source.size)
        watch = None if ready.watch is None else ready.watch.restarted()

        def retune(frame: "Frame") -> "tuple[Settings, tuple[Adjustment, ...]]":
            settings, moved = shedding(frame)
            if people_tracker is not None and moved:
                people_tracker.retune(settings)
            return settings, moved

        seen = None if people_tracker is None else people_tracker.update
        pipeline = Pipeline.from_parts(
            engine, shedding.settings, None, watch, interval, seen=seen, retune=retune, pictures=False
        )
        for surveyed in pipeline(feed):
            number = surveyed.tracked.number
            yield surveyed, None if people_tracker is None else people_tracker.people_of(number, feed.ended)

    return begin


def _person_tracker(
    scorer: "WindowScorer", settings: "Settings", interval: int, size: tuple[int, int]
) -> "PersonTracker":
    from torchvision_dddas.people import PersonTracker
    from torchvision_dddas.tracking import FrameTracker

    return PersonTracker(scorer, settings, interval, size, FrameTracker(settings, interval, size, pictures=False))
