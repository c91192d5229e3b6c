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


@pytest.mark.parametrize("look_ahead", [True, False])
@pytest.mark.parametrize("hits", [1, 3, 5])
def test_each_frame_comes_out_once_in_order_no_later_than_promised(hits, look_ahead):
    """Within `hits` + 2 looks, empty ones too."""
    run, found = tracker(hits=hits, look_ahead=look_ahead), []
    for n in range(30):
        found += run.feed(1 + 5 * n, seen(*[(100 + 10 * n, 300)] * (n % 7 != 3)))
        assert [page.frame for page in found] == [1 + 5 * k for k in range(len(found))]
        assert n - len(found) < hits + 2
    found += run.end()
    assert [page.frame for page in found] == [1 + 5 * k for k in range(30)]
    assert run.end() == []


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


@pytest.mark.parametrize("score", [1.0, DOUBTFUL])
def test_the_order_of_the_rows_only_renames_the_tracks(score):
    centres = walks(7, 20, 5, 3)
    plain = names(tracked([seen(*c, score=score) for c in centres]))
    frames, order = shuffled(centres, 8)
    again = names(tracked([Detections(f.box_px, np.full(len(f), score)) for f in frames]))
    new_name: dict[int, int] = {}
    for page, other, here in zip(plain, again, order, strict=True):
        assert len(page) == len(other)
        for row, who in other.items():
            assert new_name.setdefault(page[here[row]], who) == who
    assert len(set(new_name.values())) == len(new_name)


def test_identities_begin_at_one_leave_none_out_and_are_per_run():
    for _ in range(2):
        frames = [seen((200, 300))] * 4 + [seen((200, 300), (600, 500, 90), (900, 300))] * 4
        found = tracked([seen((900, 700), score=DOUBTFUL), *frames])
        assert [sorted(page.identity.tolist()) for page in found] == [[], *[[1]] * 4, *[[1, 2, 3]] * 4]


def test_only_a_good_detection_begins_a_track_but_a_fair_one_may_go_on_with_it():
    parameters = with_parameters(Settings(), {}).track
    fair = (parameters.min_score + parameters.birth_score) / 2
    assert not any(names(tracked([seen((300, 300), score=fair)] * 9)))
    good_then_fair = [seen((300, 300), score=parameters.birth_score)] + [seen((300, 300), score=fair)] * 8
    assert names(tracked(good_then_fair)) == [{0: 1}] * 9


def test_a_poor_detection_is_never_used():
    """It neither goes on with a track nor moves its row numbers, and does not stand in the way of a good one."""
    poor = Settings().track.min_score - 0.01
    frames = [seen((300, 300), (700, 300), score=[poor, 1.0])] * 6
    assert names(tracked(frames)) == [{1: 1}] * 6
    gone = [seen((300, 300))] * 3 + [seen((300, 300), score=poor)] * 6
    assert names(tracked(gone)) == [{0: 1}] * 3 + [{}] * 6


@pytest.mark.parametrize(("score", "looks", "shown"), [(DOUBTFUL, 2, 0), (DOUBTFUL, 3, 3), (1.0, 1, 1)])
def test_three_detections_confirm_a_track_and_a_certain_one_alone(score, looks, shown):
    frames = [seen()] * 2 + [seen((300, 300), score=score)] * looks + [seen()] * 5
    assert sum(map(len, names(tracked(frames)))) == shown


@pytest.mark.parametrize("gap", [1, 2, 3, 4])
def test_short_gaps_are_filled_longer_ones_are_not_and_both_are_bridged(gap):
    def here(n: int) -> tuple[float, float]:
        return 200 + 15.0 * n, 300

    frames = [seen(here(n)) if not 8 <= n < 8 + gap else seen() for n in range(20)]
    for n, page in enumerate(tracked(frames)):
        missed = 8 <= n < 8 + gap
        assert page.identity.tolist() == ([] if missed and gap > 2 else [1])
        assert page.row.tolist() == ([] if missed and gap > 2 else [-1] if missed else [0])
        if len(page):
            np.testing.assert_allclose(page.box_px, boxes(here(n)), atol=1e-9)


def test_who_stands_still_behind_something_comes_back_as_the_same():
    """Others walk past it meanwhile, and it had been walking."""
    frames, people = [], []
    for n in range(30):
        stands = 150 + 12.0 * min(n, 8), 300
        others = [(100 + 25.0 * n, 330), (1000 - 25.0 * n, 360)]
        hidden = 9 <= n < 17
        frames.append(seen(*others) if hidden else seen(*others, stands))
        people.append([0, 1] if hidden else [0, 1, 2])
    found = tracked(frames)
    assert switches(found, people) == 0
    assert names(found)[-1] == names(found)[0] == {0: 1, 1: 2, 2: 3}


def test_who_left_the_picture_is_remembered_for_less_long_than_who_was_lost_inside():
    """One walks out at the side; one walks there too, but is lost so early that it may as well have turned."""
    for start, size, remembered in ((1060, SIZE, 0), (700, SIZE, 1), (1060, None, 1)):
        run = tracker(size=size)
        for n in range(26):
            run.feed(1 + 5 * n, seen((start + 25.0 * n, 300)) if n < 6 else seen())
        assert len(run.tracks) == remembered


def test_who_was_never_confirmed_is_soon_dropped():
    run = tracker()
    for n in range(24):
        alarm = [(80 + 45 * n, 100)] * (n % 3 == 0)
        run.feed(1 + 5 * n, seen((600, 600), *alarm, score=[1.0, DOUBTFUL][: 1 + len(alarm)]))
        assert len(run.tracks) <= 3
        assert len(run.smoother.counts) <= 3


def test_one_target_for_ever_keeps_its_identity_and_the_tracker_its_size():
    run, found = tracker(), []
    for n in range(600):
        found += run.feed(1 + 5 * n, seen((600 + 200 * np.sin(n / 20), 400)))
        assert len(run.tracks) <= 1
    found += run.end()
    assert all(page.identity.tolist() == [1] for page in found)


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


def test_a_camera_that_moves_does_not_pass_for_people_that_run():
    frames, _ = shuffled(walks(6, 20, 5, 1, speed=3.0))
    steps, now_from_first = filmed(20, 1, roughness=1.0)
    standing, moving = tracker(size=None), tracker(size=None)
    for n, (frame, step, h) in enumerate(zip(frames, steps, now_from_first, strict=True)):
        standing.feed(1 + 5 * n, frame)
        moving.feed(1 + 5 * n, Detections(transform_boxes(frame.box_px, h), frame.score), step)
    assert standing.speed_prior.speed != standing.speed_prior.start
    assert moving.speed_prior.speed == pytest.approx(standing.speed_prior.speed, rel=1e-6)


def coloured(*bins: int) -> Callable[[], np.ndarray]:
    """Each target in a colour of its own; -1 is unknown."""
    return lambda: np.array([np.eye(12, dtype=np.float32)[b] if b >= 0 else np.zeros(12, np.float32) for b in bins])


def never() -> np.ndarray:
    raise AssertionError("pictures of targets were compared")


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


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_colours_belong_to_rows_also_where_some_rows_are_not_used(order):
    score = [0.1, 1, 1]
    frames = [seen((600, 300), (300, 300), (340, 300), score=score)] * 4
    frames += [seen((600, 300), (320, 292), (320, 308), score=score)] * 4
    colours = [coloured(3, 3, 7)] * 4 + [coloured(7, *(np.array([3, 7])[[*order]]))] * 4
    assert names(tracked(frames, pictures=colours))[-1] == {1: 1 + order[0], 2: 1 + order[1]}


def test_frames_at_uneven_distances_are_linked_by_their_numbers():
    """A walker is found again where it must be after so many frames, though another stands nearer to its last place."""
    run, found = tracker(), []
    for frame in (1, 6, 11, 16, 36, 41):
        found += run.feed(frame, seen((100 + 6.0 * frame, 300), (330, 310)))
    assert names(found + run.end()) == [{0: 1, 1: 2}] * 6


@pytest.mark.parametrize("every", [2, 5])
def test_false_alarms_elsewhere_do_not_cost_a_still_target_its_identity(every):
    """It is missed for a single look now and then, and comes back exactly where it was; nobody else is near."""
    random, frames = np.random.default_rng(0), []
    for n in range(150):
        alarm = [tuple(random.uniform((100, 100), (1100, 400)))] * (n % 3 == 0)
        still = [(600, 600)] * (n % every != 1)
        frames.append(seen(*still, *alarm, score=[1.0] * len(still) + [DOUBTFUL] * len(alarm)))
    found = names(tracked(frames, 1))
    assert len({page[0] for n, page in enumerate(found) if n % every != 1}) == 1
