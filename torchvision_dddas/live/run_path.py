"""The path of a live run from frames to results, which restarts after an error and sheds load."""

from collections.abc import Callable, Iterator
from dataclasses import replace

from torchvision_dddas.config import Settings, with_parameters
from torchvision_dddas.detection import OnnxDetector, load_engine
from torchvision_dddas.live.capture import LiveSource
from torchvision_dddas.live.health import Health
from torchvision_dddas.live.runner import Feed, LoadShedding, Result
from torchvision_dddas.people import PersonTracker, load_scorer
from torchvision_dddas.pipeline import Assembly, Pipeline
from torchvision_dddas.tracking import FrameTracker
from torchvision_dddas.types import Adjustment, Frame


def build_path(
    ready: Assembly,
    source: LiveSource,
    people: bool,
    interval: int,
    backend: str,
    health: Health,
    prepare: Callable[[], Assembly],
    detector: OnnxDetector | None = None,
    movers: bool = False,
    lag: int | None = None,
) -> Callable[[Feed], Iterator[Result]]:
    """Return the path from frames to results, which restarts at each call, and sheds load.

    prepare: makes `ready` again for pictures of another size. lag: as for `Tracker`, for targets alone.
    Raise InputError at once for pictures that are too small for people.
    """
    settings, scorer = ready.settings, None
    if people:
        # Searching the whole picture takes as long as many pictures take to arrive.
        share = min(settings.people.look_share, 0.1)
        settings = with_parameters(settings, {"people.search": "regions", "people.look_share": share})
        scorer = load_scorer(settings.people, backend)
    shedding = LoadShedding(source, settings, health, people)
    engines = iter([ready.engine])

    def build_person_tracker(size: tuple[int, int]) -> PersonTracker | None:
        if scorer is None:
            return None
        tracker = FrameTracker(shedding.settings, interval, size, pictures=False, rate_hz=source.rate_hz)
        return PersonTracker(scorer, shedding.settings, interval, size, tracker)

    watch, watch_size = ready.watch, source.size
    build_person_tracker(watch_size)

    def begin(feed: Feed) -> Iterator[Result]:
        # After an error, no object that remembers a frame is used again.
        nonlocal watch, watch_size
        if watch is not None and feed.size != watch_size:  # the camera model depends on the size
            watch, watch_size = prepare().watch, feed.size
        engine = next(engines, None) or load_engine(backend, shedding.settings)
        person_tracker = build_person_tracker(feed.size)

        def retune(frame: Frame) -> tuple[Settings, tuple[Adjustment, ...]]:
            settings, adjustments = shedding(frame)
            if person_tracker is not None and adjustments:
                person_tracker.retune(settings)
            return settings, adjustments

        running = None if watch is None else watch.restarted()
        feed.locator = None if running is None else running.locator
        if running is not None and feed.log is not None:
            locator = running.locator
            feed.aligned = lambda log: locator.set_site(replace(locator.site, telemetry=log))
            feed.aligned(feed.log)
        pipeline = Pipeline.from_assembly(
            Assembly(shedding.settings, engine, None, running),
            interval=interval,
            seen=None if person_tracker is None else person_tracker.update,
            retune=retune,
            pictures=False,
            detector=detector,
            movers=movers,
            lag=lag,
        )
        feed.began(pipeline)
        for result in pipeline(feed):
            if person_tracker is None or result.tracks.provisional:
                yield result, None
            else:
                yield result, person_tracker.people_of(result.number, feed.ended)

    return begin
