"""Clips taken through a back end together: what their loops ask for at one time is answered as one batch.

A clip's scenes are those that `run.run` gives it alone, to the last digit: the back end's answers do not depend on what
else is in a batch, nor on their order.
"""

import time
from collections.abc import Iterator, Mapping, Sequence
from itertools import chain
from typing import Any

from torchvision_dddas.config import Settings
from torchvision_dddas.detection.detector import Ask, Steps, running
from torchvision_dddas.detection.detector import Clip as Frames
from torchvision_dddas.detection.engine import Engine, load_engine
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.record import Clip
from torchvision_dddas.evaluation.studies.memory import Peak
from torchvision_dddas.evaluation.studies.record import Found
from torchvision_dddas.evaluation.studies.rows import Kept, Tick
from torchvision_dddas.evaluation.studies.stages import labelled, narrowed, opened
from torchvision_dddas.types import Scene, Telemetry

BATCH = 8  # windows at once, over all clips: as many as `run.run` gives to torch of one


def find_motion_together(
    clips: Sequence[Clip], settings: Settings, backend: str = "torch", tick: Tick = lambda: None
) -> dict[str, Found | InputError]:
    """What moves in each of the clips, by name; of a clip that will not do, why. As `stages.find` finds it in each.

    seconds and peak_mb are shares of the time and the peak of all of them.
    """
    settings, peak, start = narrowed(settings, "motion"), Peak(), time.perf_counter()
    found: dict[str, Found | InputError] = {}
    sources = {}
    for clip in clips:
        try:
            sources[clip.name] = opened(clip)
        except InputError as error:
            found[clip.name] = error
    kept = {clip.name: Kept(labelled(clip), tick) for clip in clips if clip.name in sources}
    frames = dict.fromkeys(kept, 0)
    ended = dict[str, InputError | None]()
    for name, said in scenes_together(sources, load_engine(backend, settings), settings):
        if isinstance(said, Scene):
            kept[name].add(said)
            frames[name] += 1
        else:
            ended[name] = said
    rows = {name: one.rows() for name, one in kept.items()}
    other = time.perf_counter() - start - sum(sum(one.seconds.values()) for one in rows.values())
    for name, end in ended.items():
        if end is not None:
            found[name] = end
            continue
        rows[name].notes += map(str, sources[name].problems)
        rows[name].seconds["other"] = other * frames[name] / max(sum(frames.values()), 1)
        found[name] = rows[name].found(peak.mb())
    return {clip.name: found[clip.name] for clip in clips}


def scenes_together(
    clips: Mapping[str, Frames],
    engine: Engine,
    settings: Settings,
    telemetry: Mapping[str, Telemetry] | None = None,
    batch: int | None = None,
) -> Iterator[tuple[str, Scene | InputError | None]]:
    """Scenes by the clips' names as they are settled, each clip's in order; at a clip's end None, or why it ended.

    Frames of one size go to the back end as one batch; clips of other sizes are as right, and no quicker than alone.
    batch: windows of each clip at once; by default as many as make BATCH of all clips. A clip's bad input ends that
    clip alone.
    """
    logs = telemetry or {}
    each = batch or max(1, -(-BATCH // max(len(clips), 1)))
    loops = {name: running(clip, engine, settings, logs.get(name), each) for name, clip in clips.items()}
    answers: dict[str, list[Any] | None] = dict.fromkeys(loops)
    while answers:
        asked: dict[str, Ask] = {}
        for name, answer in answers.items():
            yield from _until_it_asks(name, loops[name], answer, asked)
        answers = _answered(asked, engine)


def _until_it_asks(
    name: str, loop: Steps, answer: list[Any] | None, asked: dict[str, Ask]
) -> Iterator[tuple[str, Scene | InputError | None]]:
    """The scenes of a clip until its loop asks for something, which is put into `asked`, or ends."""
    while True:
        try:
            said = loop.send(answer)
        except StopIteration:
            yield name, None
            return
        except InputError as error:
            yield name, error
            return
        if isinstance(said, Ask):
            asked[name] = said
            return
        yield name, said
        answer = None


def _answered(asked: Mapping[str, Ask], engine: Engine) -> dict[str, list[Any] | None]:
    """The answers by name. Each bears the share of the time that its items have in all that were asked with them."""
    answers: dict[str, list[Any] | None] = {}
    for what in ("register", "foreground"):
        asks = {name: ask for name, ask in asked.items() if ask.what == what}
        if not asks:
            continue
        start = time.perf_counter()
        found = iter(getattr(engine, what)(list(chain.from_iterable(ask.items for ask in asks.values()))))
        each = (time.perf_counter() - start) / sum(len(ask.items) for ask in asks.values())
        for name, ask in asks.items():
            ask.seconds = each * len(ask.items)
            answers[name] = [next(found) for _ in ask.items]
    return {name: answers[name] for name in asked}
