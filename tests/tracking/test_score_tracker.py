"""The default tracker on simulated walks."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as given_settings
from hypothesis import strategies as st

from torchvision_dddas.config import Settings, with_parameters
from torchvision_dddas.tracking.kalman import transform_boxes
from torchvision_dddas.tracking.score_tracker import ScoreTracker
from torchvision_dddas.types import Detections, Tracks

SIZE = (1200.0, 800.0)
HEIGHT = 80.0
DOUBTFUL = (1 + Settings().track.birth_score) / 2  # may begin a track, but is not certain


def boxes(*centres: Sequence[float]) -> np.ndarray:
    """People 80 px high; a third number is the height of another one."""
    centre = np.array([c[:2] for c in centres], float).reshape(-1, 2)
    height = np.array([c[2] if len(c) > 2 else HEIGHT for c in centres])
    size = np.stack([0.4 * height, height], axis=1)
    return np.concatenate([centre - size / 2, size], axis=1)


def seen(*centres: Sequence[float], score: float | Sequence[float] = 1.0) -> Detections:
    return Detections(boxes(*centres), np.broadcast_to(np.asarray(score, float), len(centres)).copy())


def tracker(interval: int = 5, size: tuple[float, float] | None = SIZE, **parameters: Any) -> ScoreTracker:
    return ScoreTracker(
        with_parameters(Settings(), {f"track.{name}": value for name, value in parameters.items()}), interval, size
    )


def tracked(
    frames: Sequence[Detections],
    interval: int = 5,
    size: tuple[float, float] | None = SIZE,
    steps: Sequence[np.ndarray | None] | None = None,
    pictures: Sequence[Callable[[], np.ndarray]] | None = None,
    **parameters: Any,
) -> list[Tracks]:
    """All frames' tracks, frames 1, 1 + interval, ..."""
    run, found = tracker(interval, size, **parameters), []
    for n, detections in enumerate(frames):
        step, look = steps[n] if steps else None, pictures[n] if pictures else None
        found += run.feed(1 + interval * n, detections, step, look)
    return found + run.end()


def names(found: Sequence[Tracks]) -> list[dict[int, int]]:
    """{row: identity} of each frame, filled gaps left out."""
    return [
        {row: who for row, who in zip(page.row.tolist(), page.identity.tolist(), strict=True) if row >= 0}
        for page in found
    ]


def switches(found: Sequence[Tracks], people: Sequence[Sequence[int]]) -> int:
    """How often a person's identity is not the one before; -1 never counts. people: (frames, rows) who is who."""
    last: dict[int, int] = {}
    wrong = 0
    for page, here in zip(names(found), people, strict=True):
        for row, person in enumerate(here):
            if (who := page.get(row)) is not None:
                wrong += last.setdefault(person, who) != who
                last[person] = who
    return wrong


def walks(count: int, looks: int, interval: int, seed: int, speed: float = 4.0) -> np.ndarray:
    """(looks, count, 2) centres of people who walk straight on in all directions and cross each other's ways."""
    random = np.random.default_rng(seed)
    middle = random.uniform((300, 200), (900, 600), (count, 2))
    angle = random.uniform(0, 2 * np.pi, count)
    velocity = speed * random.uniform(0.4, 1, count)[:, None] * np.stack([np.cos(angle), 0.5 * np.sin(angle)], axis=1)
    time = interval * (np.arange(looks) - looks / 2)
    return middle + time[:, None, None] * velocity


def shuffled(centres: np.ndarray, seed: int = 0) -> tuple[list[Detections], list[list[int]]]:
    """The frames with their rows in disorder, and whose row each is."""
    random = np.random.default_rng(seed)
    order = [random.permutation(centres.shape[1]) for _ in centres]
    return [seen(*c[o]) for c, o in zip(centres, order, strict=True)], [o.tolist() for o in order]


@given_settings(max_examples=8, deadline=None)
@given(st.integers(0, 1000), st.integers(2, 14))
def test_what_has_come_out_is_the_same_whatever_comes_later(seed, stop):
    """So a run online and a batch run agree: nothing is taken back, and nothing depends on what is to come."""
    frames, _ = shuffled(walks(5, 16, 5, seed), seed)
    rest = [seen(*np.random.default_rng(seed).uniform(100, 700, (4, 2)), score=DOUBTFUL) for _ in range(16 - stop)]
    one, other = tracker(), tracker()
    for n, (first, second) in enumerate(zip(frames, frames[:stop] + rest, strict=True)):
        out, again = one.feed(1 + 5 * n, first), other.feed(1 + 5 * n, second)
        if n < stop:
            assert_same(out, again)


def assert_same(one: Sequence[Tracks], other: Sequence[Tracks]) -> None:
    assert len(one) == len(other)
    for page, again in zip(one, other, strict=True):
        assert page.frame == again.frame
        for name in ("identity", "box_px", "score", "row"):
            np.testing.assert_array_equal(getattr(page, name), getattr(again, name))


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("interval", [5, 8])
def test_people_whose_ways_cross_keep_their_identities_at_a_low_frame_rate(seed, interval):
    frames, people = shuffled(walks(6, 24, interval, seed, speed=3.0), seed)
    found = tracked(frames, interval, None)
    assert switches(found, people) == 0
    assert {who for page in found for who in page.identity.tolist()} == set(range(1, 7))
    assert all(len(page) == 6 for page in found)


def test_who_left_the_picture_is_remembered_for_less_long_than_who_was_lost_inside():
    """One walks out at the side; one walks there too, but is lost so early that it may as well have turned."""
    for start, size, remembered in ((1060, SIZE, 0), (700, SIZE, 1), (1060, None, 1)):
        run = tracker(size=size)
        for n in range(26):
            run.feed(1 + 5 * n, seen((start + 25.0 * n, 300)) if n < 6 else seen())
        assert len(run.tracks) == remembered


def filmed(looks: int, seed: int, roughness: float) -> tuple[list[np.ndarray | None], list[np.ndarray]]:
    """Steps of a camera that pans, turns a little and zooms, and where the first picture is in each."""
    random = np.random.default_rng(seed)
    steps: list[np.ndarray | None] = [None]
    now_from_first = [np.eye(3)]
    for _ in range(looks - 1):
        zoom, turn = np.exp(random.normal(0, 0.08 * roughness)), random.normal(0, 0.03 * roughness)
        cos, sin = zoom * np.cos(turn), zoom * np.sin(turn)
        pan = random.normal(0, 90 * roughness, 2)
        step = np.array([[cos, -sin, pan[0]], [sin, cos, pan[1]], [0, 0, 1]])
        step = (
            np.array([[1, 0, 600], [0, 1, 400], [0, 0, 1]]) @ step @ np.array([[1, 0, -600], [0, 1, -400], [0, 0, 1]])
        )
        steps.append(step)
        now_from_first.append(step @ now_from_first[-1])
    return steps, now_from_first


@pytest.mark.parametrize("seed", range(4))
def test_a_moving_camera_known_by_its_homographies_gives_the_identities_of_one_that_stands(seed):
    """And without them the same boxes are confused, so the test is hard enough to show what the registration is for."""
    centres = walks(6, 20, 5, seed, speed=3.0)
    frames, people = shuffled(centres, seed)
    steps, now_from_first = filmed(20, seed, roughness=1.0)
    moved = [Detections(transform_boxes(f.box_px, h), f.score) for f, h in zip(frames, now_from_first, strict=True)]
    standing = tracked(frames, size=None)
    assert switches(standing, people) == 0
    assert names(tracked(moved, size=None, steps=steps)) == names(standing)
    assert switches(tracked(moved, size=None), people) > 5


def coloured(*bins: int) -> Callable[[], np.ndarray]:
    """Each target in a colour of its own; -1 is unknown."""
    return lambda: np.array([np.eye(12, dtype=np.float32)[b] if b >= 0 else np.zeros(12, np.float32) for b in bins])


@pytest.mark.parametrize("look_ahead", [True, False])
@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_colours_tell_apart_whom_places_confuse(order, look_ahead):
    """Two people meet: each is as near to where the one was as to where the other was."""
    frames = [seen((300, 300), (340, 300))] * 4 + [seen((320, 292), (320, 308))] * 4
    colours = [coloured(3, 7)] * 4 + [coloured(*(np.array([3, 7])[[*order]]))] * 4
    found = names(tracked(frames, pictures=colours, look_ahead=look_ahead))
    assert found == [{0: 1, 1: 2}] * 4 + [{0: 1 + order[0], 1: 1 + order[1]}] * 4


@pytest.mark.parametrize(
    ("order", "appearance"),
    [((0, 1), "always"), ((1, 0), "always"), ((0, 1), "ambiguous"), ((1, 0), "ambiguous")],
)
def test_colours_that_are_seen_only_in_the_next_look_decide_too(order, appearance):
    """Where they meet neither can be told; then they part, and each went on from the nearer place."""
    frames = [seen((300, 300), (340, 300))] * 4 + [seen((320, 290), (320, 310))] + [seen((320, 275), (320, 325))] * 4
    colours = [coloured(3, 7)] * 4 + [coloured(-1, -1)] + [coloured(*(np.array([3, 7])[[*order]]))] * 4
    found = names(tracked(frames, pictures=colours, appearance=appearance))
    assert found[4:] == [{0: 1 + order[0], 1: 1 + order[1]}] * 5


def test_pictures_are_looked_at_where_places_leave_a_doubt_and_once_at_most():
    """Two who walk alone until they meet: what the doubts ask for is asked once, and is enough."""
    asked = [0] * 16

    def looked(n: int) -> Callable[[], np.ndarray]:
        def look() -> np.ndarray:
            asked[n] += 1
            return coloured(3, 7)()

        return look

    frames = [seen((200 + 25 * min(n, 8), 300), (1000 - 72 * min(n, 8), 300)) for n in range(16)]
    doubts = names(tracked(frames, pictures=[looked(n) for n in range(16)], appearance="ambiguous"))
    assert max(asked) == 1
    assert sum(asked[4:6]) == 0 < sum(asked[8:])
    asked[:] = [0] * 16
    assert names(tracked(frames, pictures=[looked(n) for n in range(16)], appearance="always")) == doubts
    assert asked == [1] * 16
