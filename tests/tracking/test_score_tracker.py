"""The default tracker on simulated walks."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest

from torchvision_dddas.config import Settings, with_parameters
from torchvision_dddas.tracking.kalman import transform_boxes
from torchvision_dddas.tracking.score_tracker import ScoreTracker
from torchvision_dddas.types import Detections, Tracks

SIZE = (1200.0, 800.0)
HEIGHT = 80.0


def boxes(*centres: Sequence[float]) -> np.ndarray:
    """People 80 px high."""
    size = np.array([0.4 * HEIGHT, HEIGHT])
    centre = np.array(centres, float).reshape(-1, 2)
    return np.concatenate([centre - size / 2, np.broadcast_to(size, centre.shape)], axis=1)


def seen(*centres: Sequence[float], score: float | Sequence[float] = 1.0) -> Detections:
    return Detections(boxes(*centres), np.broadcast_to(np.asarray(score, float), len(centres)).copy())


def tracker(interval: int = 5, size: tuple[float, float] | None = SIZE, **parameters: Any) -> ScoreTracker:
    changed = {f"track.{name}": value for name, value in parameters.items()}
    return ScoreTracker(with_parameters(Settings(), changed), interval, size)


def tracked(frames, interval=5, size=None, steps=None, pictures=None, **parameters) -> list[Tracks]:
    """The tracks of frames 1, 1 + interval, ..."""
    run, found = tracker(interval, size, **parameters), []
    for n, detections in enumerate(frames):
        found += run.feed(1 + interval * n, detections, steps[n] if steps else None, pictures[n] if pictures else None)
    return found + run.end()


def names(found: Sequence[Tracks]) -> list[dict[int, int]]:
    """{row: identity} of each frame, filled gaps left out."""
    rows = [zip(page.row.tolist(), page.identity.tolist(), strict=True) for page in found]
    return [{row: identity for row, identity in page if row >= 0} for page in rows]


def switches(found: Sequence[Tracks], people: Sequence[Sequence[int]]) -> int:
    """How often the identity of a person changes. people: whose row each is, of every frame."""
    last: dict[int, int] = {}
    wrong = 0
    for page, here in zip(names(found), people, strict=True):
        for row, identity in page.items():
            wrong += last.setdefault(here[row], identity) != identity
            last[here[row]] = identity
    return wrong


def walks(count: int, steps: int, interval: int, seed: int, speed: float = 4.0) -> np.ndarray:
    """(steps, count, 2) centres of people who walk straight on in all directions and cross each other's ways."""
    random = np.random.default_rng(seed)
    middle = random.uniform((300, 200), (900, 600), (count, 2))
    angle = random.uniform(0, 2 * np.pi, count)
    velocity = speed * random.uniform(0.4, 1, count)[:, None] * np.stack([np.cos(angle), 0.5 * np.sin(angle)], axis=1)
    return middle + (interval * (np.arange(steps) - steps / 2))[:, None, None] * velocity


def shuffled(centres: np.ndarray, seed: int) -> tuple[list[Detections], list[list[int]]]:
    """The frames with their rows in disorder, and whose row each is."""
    random = np.random.default_rng(seed)
    order = [random.permutation(centres.shape[1]) for _ in centres]
    return [seen(*c[o]) for c, o in zip(centres, order, strict=True)], [o.tolist() for o in order]


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("interval", [5, 8])
def test_people_whose_paths_cross_keep_their_identities_at_a_low_frame_rate(seed, interval):
    frames, people = shuffled(walks(6, 24, interval, seed, speed=3.0), seed)
    found = tracked(frames, interval)
    assert switches(found, people) == 0
    assert all(sorted(page.identity.tolist()) == [1, 2, 3, 4, 5, 6] for page in found)


@pytest.mark.parametrize(("start", "size", "remembered"), [(1060, SIZE, 0), (700, SIZE, 1), (1060, None, 1)])
def test_a_target_that_left_the_picture_is_forgotten_sooner_than_one_lost_inside(start, size, remembered):
    run = tracker(size=size)
    for n in range(26):
        run.feed(1 + 5 * n, seen((start + 25.0 * n, 300)) if n < 6 else seen())
    assert len(run.tracks) == remembered


def camera_motion(count: int, seed: int) -> tuple[list[np.ndarray | None], list[np.ndarray]]:
    """Steps of a camera that pans, turns a little and zooms, and where the first picture is in each."""
    random = np.random.default_rng(seed)
    steps: list[np.ndarray | None] = [None]
    now_from_first = [np.eye(3)]
    for _ in range(count - 1):
        (a, b), pan = random.normal((1, 0), (0.08, 0.03)), random.normal(0, 90, 2)
        middle = np.array([600.0, 400])
        turn = np.array([[a, -b], [b, a]])
        step = np.eye(3)
        step[:2, :2], step[:2, 2] = turn, middle + pan - turn @ middle
        steps.append(step)
        now_from_first.append(step @ now_from_first[-1])
    return steps, now_from_first


@pytest.mark.parametrize("seed", range(4))
def test_identities_under_a_moving_camera_with_known_homographies_equal_those_of_a_still_one(seed):
    frames, people = shuffled(walks(6, 20, 5, seed, speed=3.0), seed)
    steps, now_from_first = camera_motion(20, seed)
    moved = [Detections(transform_boxes(f.box_px, h), f.score) for f, h in zip(frames, now_from_first, strict=True)]
    still = tracked(frames)
    assert switches(still, people) == 0
    assert names(tracked(moved, steps=steps)) == names(still)


@pytest.mark.parametrize("seed", range(4))
def test_identities_survive_a_jerky_pan_that_only_the_boxes_show(seed):
    """The camera jumps by about a height from look to look, each time elsewhere; the people walk well apart."""
    random = np.random.default_rng(seed)
    grid = np.stack(np.meshgrid([300.0, 600, 900], [250.0, 550]), axis=-1).reshape(6, 2)
    places = grid + random.normal(0, 40, (6, 2))
    walk = np.arange(20)[:, None, None] * random.uniform(-4, 4, (6, 2))
    jerk = random.normal(0, 60, (20, 1, 2))
    frames, people = shuffled(places + walk + jerk, seed)
    found = tracked(frames, interval=1)
    assert switches(found, people) == 0
    assert all(sorted(page.identity.tolist()) == [1, 2, 3, 4, 5, 6] for page in found)


@pytest.mark.parametrize("score", [1.0, 0.8])
def test_a_frame_rate_that_is_not_told_gives_the_same_identities(score):
    """Frames 1, 6, 11, ... at interval 5, and the same ones numbered 1, 2, 3, ... at interval 1."""
    random, (frames, _) = np.random.default_rng(0), shuffled(walks(6, 24, 5, 0, speed=3.0), 0)
    seen_ones = [d.box_px[random.random(6) < 0.9] for d in frames]
    given = [Detections(box, np.full(len(box), score)) for box in seen_ones]
    told, untold = (tracked(given, interval, SIZE) for interval in (5, 1))
    assert names(told) == names(untold)
    for one, other in zip(told, untold, strict=True):
        np.testing.assert_allclose(one.box_px, other.box_px)


@pytest.mark.parametrize("usual", [0.95, 0.8, 0.6])
def test_detections_much_less_likely_than_the_usual_ones_get_no_identity(usual):
    random, found = np.random.default_rng(0), []
    places = random.uniform((100, 100), (1100, 700), (6, 2))
    for score in (0.1, usual - 0.05):
        frames = [seen(*(places + random.normal(0, 1, (6, 2))), score=[usual] * 4 + [score] * 2) for _ in range(10)]
        found.append({row for page in names(tracked(frames)) for row in page})
    assert found == [set(range(4)), set(range(6))]


def coloured(*bins: int) -> Callable[[], np.ndarray]:
    """Each target in a colour of its own; -1 is unknown."""
    return lambda: np.array([np.eye(12, dtype=np.float32)[b] if b >= 0 else np.zeros(12, np.float32) for b in bins])


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
@pytest.mark.parametrize(
    ("options", "delay"),
    [
        ({"look_ahead": True}, 0),
        ({"look_ahead": False}, 0),
        ({"appearance": "always"}, 1),  # the colours are unknown where the two meet, and known in the next frame
        ({"appearance": "ambiguous"}, 1),
    ],
)
def test_colours_decide_where_places_are_ambiguous(order, options, delay):
    """Two people meet: each is as near to where the one was as to where the other was."""
    frames = [seen((300, 300), (340, 300))] * 4 + [seen((320, 290), (320, 310))]
    frames += [seen((320, 275), (320, 325)) if delay else frames[-1]] * 4
    crossed = coloured(*np.array([3, 7])[[*order]])
    colours = [coloured(3, 7)] * 4 + [coloured(-1, -1) if delay else crossed] + [crossed] * 4
    found = names(tracked(frames, pictures=colours, **options))
    assert found == [{0: 1, 1: 2}] * 4 + [{0: 1 + order[0], 1: 1 + order[1]}] * 5


@pytest.mark.parametrize("appearance", ["ambiguous", "always"])
def test_colours_are_computed_only_where_places_are_ambiguous_and_once_at_most(appearance):
    asked = [0] * 16

    def counted(n: int) -> Callable[[], np.ndarray]:
        def compute() -> np.ndarray:
            asked[n] += 1
            return coloured(3, 7)()

        return compute

    # Two walk alone until they meet.
    frames = [seen((200 + 25 * min(n, 8), 300), (1000 - 72 * min(n, 8), 300)) for n in range(16)]
    found = tracked(frames, pictures=[counted(n) for n in range(16)], appearance=appearance)
    assert names(found) == [{0: 1, 1: 2}] * 16
    if appearance == "always":
        assert asked == [1] * 16
    else:
        assert max(asked) == 1 and sum(asked[4:6]) == 0 < sum(asked[8:])
