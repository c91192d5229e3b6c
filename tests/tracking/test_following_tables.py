"""Tables that were written by `dddas detect`, and tables with long stretches without rows."""

from dataclasses import replace
from typing import cast

import numpy as np
import pytest

from torchvision_dddas.config import load_config
from torchvision_dddas.detection import load_engine
from torchvision_dddas.tracking.sequence import follow_clip, follow_scenes, follow_table
from torchvision_dddas.tracking.source_tracker import PaperTracker
from torchvision_dddas.tracking.tracker import Tracker
from torchvision_dddas.types import Detections, DetectionTable, Frame, Scene, Source

SETTINGS = load_config()
SIZE = (320, 240)


def table_of(frames, seed=0, score=1.0, people=4):
    """People who walk about, each seen in nine of ten of these frames, and now and then a false alarm."""
    random = np.random.default_rng(seed)
    start, velocity = random.uniform(40, 200, (people, 2)), random.normal(0, 1, (people, 2))
    rows = []
    for k, frame in enumerate(frames):
        seen = np.flatnonzero(random.random(people) < 0.9)
        rows += [(frame, *(start[at] + velocity[at] * k + random.normal(0, 0.5, 2)), 12, 40) for at in seen]
        if random.random() < 0.1:
            rows.append((frame, *random.uniform(0, 300, 2), 12, 40))
    table = np.array(rows)
    n = len(table)
    return DetectionTable("det.txt", table[:, 0].astype(int), table[:, 1:], np.full(n, score), np.arange(n) + 1)


def found(tracks):
    """Frame -> (identity, box, row) of those that have any."""
    return {
        t.frame: list(zip(t.identity.tolist(), map(tuple, t.box_px.tolist()), t.row.tolist(), strict=True))
        for t in tracks
        if len(t)
    }


@pytest.mark.parametrize("interval", [1, 4])
@pytest.mark.parametrize(("mode", "score"), [("default", 1.0), ("default", 0.97), ("paper", 1.0)])
@pytest.mark.parametrize(("memory", "hits"), [(1, 1), (9, 3), (20, 6)])
def test_a_long_stretch_without_rows_is_left_out_and_changes_no_track(interval, mode, score, memory, hits):
    parameters = {"memory_frames": memory, "hits": hits, "mode": mode, "look_ahead": "true" if hits > 1 else "false"}
    settings = load_config(overrides=[f"track.{name}={value}" for name, value in parameters.items()])
    table = table_of(
        [*range(1, 60), *range(200, 260), *range(262, 280), *range(400, 440), *range(450, 460)], score=score
    )
    tracker = (PaperTracker if mode == "paper" else Tracker)(settings, interval, table.extent)
    numbers = range(1, table.last + 1, interval)
    whole = [t for n in numbers for t in tracker.feed(n, table.at(n))] + tracker.end()
    followed = list(follow_table(table, settings, interval))
    assert found(f.tracks for f in followed) == found(whole)
    fed = [f.number for f in followed]
    rows = sorted({n for n in table.frame.tolist() if (n - 1) % interval == 0})
    assert set(rows) <= set(fed) <= set(numbers) and fed == sorted(set(fed))
    assert {n - interval for n in rows[1:]} <= set(fed)
    assert {n for n in numbers if 0 < n - max((r for r in rows if r <= n), default=n) <= memory} <= set(fed)
    # Two stretches, of 140 and 120 frames, of which little more than the memory is looked at.
    assert len(numbers) - len(fed) >= (260 - 2 * (memory + (hits + 5) * interval)) // interval > 20


def test_a_track_is_remembered_over_a_stretch_that_is_shorter_than_the_memory():
    rows = [(n, 100.0, 100.0, 12.0, 40.0) for n in (*range(1, 11), *range(111, 121))]
    table = np.array(rows)
    followed = follow_table(
        DetectionTable("a", table[:, 0].astype(int), table[:, 1:], np.ones(20), np.arange(20)), SETTINGS, 1
    )
    assert {i for f in followed for i in f.tracks.identity.tolist()} == {1}


def test_a_row_on_the_last_frame_that_may_be_costs_a_few_looks():
    table = table_of([1, 2, 3, 10_000_000])
    for interval in (1, 3):
        fed = [f.number for f in follow_table(table, SETTINGS, interval)]
        assert fed[0] == 1 and fed[-2:] == [10_000_000 - interval, 10_000_000]
        assert len(fed) < 200


@pytest.mark.parametrize("frames", [[5, 6], [2, 3, 4], [3, 24]])
def test_frames_run_from_the_first_to_the_last_row_whether_or_not_these_are_looked_at(frames):
    rows = [f.number for f in follow_table(table_of(frames), SETTINGS, 7)]
    assert rows == [n for n in range(1, 30, 7) if frames[0] <= n <= frames[-1]]


# -- what `dddas detect` wrote -------------------------------------------------------------------------------------


def own(frames=40):
    """Targets of faint contrast of whom now all is seen, now the trunk or the legs alone, now the shadow as well."""
    random, shown = np.random.default_rng(0), [(0, 0, 1, 1), (0, 0, 1, 0.65), (0, 0.35, 1, 0.65), (0, 0, 2, 1)]
    boxes = []
    for n in range(frames):
        whole = np.array([[20 + 2 * n, 60, 12, 40], [20 + 2 * n, 140, 12, 40.0]])
        parts = np.array([shown[k] for k in random.integers(0, 4, 2)])
        boxes.append(np.concatenate([whole[:, :2] + parts[:, :2] * whole[:, 2:], parts[:, 2:] * whole[:, 2:]], axis=1))
    n = 2 * frames
    return DetectionTable(
        *("detections.csv", np.repeat(np.arange(frames) + 1, 2), np.concatenate(boxes), np.full(n, 0.55)),
        *(np.arange(n) + 2, True),
    )


class Blank:
    """A clip without anything in it."""

    size, count, exact, rate_hz, problems, name = SIZE, 40, True, 10.0, (), "blank"
    last = 40

    def every(self, interval):
        for n in range(1, 41, interval):
            yield Frame(n, n / 10, np.full((240, 320, 3), 90, np.uint8))


def test_the_table_of_a_clip_s_own_detections_is_followed_as_these_are_with_and_without_the_clip():
    table = own()
    scenes = []
    for frame in Blank().every(1):
        here = table.at(frame.number)
        detections = Detections(here.box_px, here.score, here.area_px, here.heading_rad, here.speed_px)
        scenes.append(Scene(frame, np.zeros((240, 320), np.uint16), detections, 3))
    wanted = found(f.tracks for f in follow_scenes(scenes, SETTINGS, 1, SIZE))
    engine = load_engine("onboard", SETTINGS)
    assert found(f.tracks for f in follow_clip(cast(Source, Blank()), table, engine, SETTINGS, 1)) == wanted
    alone = list(follow_table(table, SETTINGS, 1))
    assert all(sorted(f.tracks.identity.tolist()) == [1, 2] for f in alone)
    assert all(f.tracks.score.tolist() == [0.55, 0.55] for f in alone)
    assert not found(f.tracks for f in follow_table(replace(table, own=False), SETTINGS, 1))
