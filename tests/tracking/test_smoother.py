"""When a frame is settled, which tracks it names, and which gaps are filled."""

from collections.abc import Mapping, Sequence

import numpy as np
import pytest

from torchvision_dddas.tracking.kalman import carried_boxes
from torchvision_dddas.tracking.smoother import FILLED, Ledger
from torchvision_dddas.types import Tracks

PAN = np.array([[1.0, 0, 7], [0, 1, -3], [0, 0, 1]])
ZOOM = np.array([[1.2, 0, -30], [0, 1.2, -20], [0, 0, 1]])


def box(number: int, look: int) -> list[float]:
    """Each track walks to the right on a line of its own."""
    return [10.0 * look, 100.0 * number, 20, 40]


def written(
    looks: Sequence[Mapping[int, float]], hits: int = 3, smooth: bool = False, seen: Sequence | None = None
) -> list[list[Tracks]]:
    """What each look settled, and the end. looks: {number of track: score}; frames are 1, 6, 11, ..."""
    ledger, settled = Ledger(hits, smooth), []
    for look, tracks in enumerate(looks):
        boxes = np.array([box(number, look) for number in tracks]).reshape(-1, 4)
        numbers, score = np.array(list(tracks), np.int64), np.array(list(tracks.values()), float)
        step = None if seen is None or look == 0 else seen[look - 1]
        ledger.write(1 + 5 * look, numbers, boxes, score, np.arange(len(numbers)), step)
        settled.append(ledger.settle())
    return [*settled, ledger.settle(everything=True)]


def pages(looks: Sequence[Mapping[int, float]], **options: object) -> list[Tracks]:
    return [page for settled in written(looks, **options) for page in settled]  # type: ignore[arg-type]


def names(found: Sequence[Tracks]) -> list[list[int]]:
    return [tracks.identity.tolist() for tracks in found]


@pytest.mark.parametrize("hits", [1, 3, 5])
def test_each_frame_is_settled_once_in_order_as_soon_as_no_later_look_can_tell(hits):
    settled = written([{0: 0.9}] * 12, hits)
    assert [page.frame for at_once in settled for page in at_once] == [1 + 5 * look for look in range(12)]
    waits = hits - 1 + FILLED
    assert [len(at_once) for at_once in settled] == [0] * waits + [1] * (12 - waits) + [waits]


def test_nothing_written_settles_nothing():
    assert written([]) == [[]]


def test_empty_looks_are_settled_too():
    found = pages([{}, {0: 1.0}, {}])
    assert names(found) == [[], [1], []]
    assert [page.box_px.shape for page in found] == [(0, 4), (1, 4), (0, 4)]


@pytest.mark.parametrize("hits", [1, 2, 3, 6])
def test_so_many_hits_confirm_a_track_from_its_first_one_on(hits):
    assert names(pages([{0: 0.9}] * hits + [{}] * 9, hits=hits))[:hits] == [[1]] * hits
    assert not any(names(pages([{0: 0.9}] * (hits - 1) + [{}] * 9, hits=hits)))


def test_a_certain_detection_confirms_alone():
    assert names(pages([{0: 1.0}, {}, {}])) == [[1], [], []]
    assert names(pages([{0: 0.9}, {0: 1.0}, {}])) == [[1], [1], []]


def test_identities_begin_at_one_and_leave_none_out_for_false_alarms():
    looks = [{5: 1.0, 9: 0.8}, {7: 0.8, 5: 1.0}, {2: 1.0, 5: 1.0}, {1: 1.0, 2: 1.0}]
    found = pages(looks)
    assert names(found) == [[1], [1], [2, 1], [3, 2]]
    assert [page.row.tolist() for page in found] == [[0], [1], [0, 1], [0, 1]]


@pytest.mark.parametrize("gap", [1, 2, 3, 4])
def test_gaps_of_two_looks_are_filled_and_longer_ones_are_not_but_the_identity_lives_on(gap):
    found = pages([{0: 1.0}, {0: 1.0}, *[{}] * gap, {0: 1.0}, {0: 1.0}])
    filled = gap <= FILLED == 2
    assert names(found) == [[1], [1], *[[1] if filled else []] * gap, [1], [1]]
    for look, page in enumerate(found):
        assert page.row.tolist() == ([] if not len(page) else [-1] if 2 <= look < 2 + gap else [0])
        np.testing.assert_allclose(page.box_px, [box(0, look)] if len(page) else np.zeros((0, 4)))


@pytest.mark.parametrize("hits", [1, 4])
def test_a_gap_is_filled_however_soon_frames_are_settled(hits):
    looks = [{0: 1.0}] * 8 + [{}] * 2 + [{0: 1.0}] * 8
    assert names(pages(looks, hits=hits)) == [[1]] * 18


def test_the_score_of_a_filled_box_lies_between_those_around_it():
    found = pages([{0: 1.0}, {}, {}, {0: 0.7}])
    np.testing.assert_allclose([page.score[0] for page in found], [1, 0.9, 0.8, 0.7])


def test_a_gap_of_a_track_that_is_never_confirmed_is_not_shown():
    assert not any(names(pages([{0: 0.8}, {}, {0: 0.8}, {}, {}])))


@pytest.mark.parametrize("score", [1.0, 0.8])
def test_the_camera_is_taken_out_of_filled_boxes(score):
    """The target stands still in the scene: each box is the first one, seen from where the camera then was."""
    first, steps = np.array([[100.0, 50, 20, 40]]), [PAN, ZOOM, PAN, ZOOM @ PAN, PAN]
    ledger = Ledger(3, True)
    here, truth = first, [first]
    ledger.write(1, np.zeros(1, int), first, np.full(1, score), np.zeros(1, int), None)
    for look, step in enumerate(steps, 2):
        here = carried_boxes(here, step)
        truth.append(here)
        seen = 0 if look in (3, 4) else 1
        ledger.write(look, np.zeros(seen, int), here[:seen], np.full(seen, score), np.zeros(seen, int), step)
    found = ledger.settle(everything=True)
    assert [page.row.tolist() for page in found] == [[0], [0], [-1], [-1], [0], [0]]
    for page, expected in zip(found, truth, strict=True):
        np.testing.assert_allclose(page.box_px, expected, rtol=1e-6)


def noisy(looks: int = 30, score: float = 0.8, missing: Sequence[int] = (), **options: bool) -> tuple[float, float]:
    """Mean distances, of the boxes out and of those in, from a straight walk."""
    random, ledger = np.random.default_rng(5), Ledger(3, options.get("smooth", True))
    given, found = {}, []
    for look in range(looks):
        seen = 0 if look in missing else 1
        given[look + 1] = np.array(box(0, look)) + random.normal(0, 4, 4)
        ledger.write(
            look + 1, np.zeros(seen, int), given[look + 1][None][:seen], np.full(seen, score), np.zeros(seen, int), None
        )
        found += ledger.settle()
    found += ledger.settle(everything=True)
    detected = [page for page in found if page.row.tolist() == [0]]
    truth = [np.array(box(0, page.frame - 1)) for page in detected]
    out = np.mean([np.abs(page.box_px[0] - true) for page, true in zip(detected, truth, strict=True)])
    return float(out), float(np.mean([np.abs(given[p.frame] - t) for p, t in zip(detected, truth, strict=True)]))


def test_doubtful_boxes_come_nearer_to_the_truth():
    out, given = noisy()
    assert out < 0.75 * given
    out, given = noisy(missing=(5, 11, 12, 20))
    assert out < 0.75 * given


def test_boxes_stay_as_given_where_they_are_certain_or_smoothing_is_off():
    assert np.subtract(*noisy(score=1.0)) == 0
    assert np.subtract(*noisy(smooth=False)) == 0
    out, given = noisy(score=0.99)
    assert out != given


def test_a_track_of_one_box_is_not_moved():
    found = pages([{0: 0.9}, {}, {}, {}], hits=1, smooth=True)
    np.testing.assert_array_equal(found[0].box_px, [box(0, 0)])


def test_the_camera_is_taken_out_before_boxes_are_smoothed():
    """A target at rest before a camera that pans and zooms is given exactly, so it must come out exactly."""
    ledger, here, truth, found = Ledger(3, True), np.array([[100.0, 50, 20, 40]]), [], []
    for look in range(40):
        step = None if look % 5 == 0 else PAN if look % 2 else ZOOM if look % 4 else np.linalg.inv(ZOOM)
        here = here if step is None else carried_boxes(here, step)
        truth.append(here)
        ledger.write(look + 1, np.zeros(1, int), here, np.full(1, 0.8), np.zeros(1, int), step)
        found += ledger.settle()
    found += ledger.settle(everything=True)
    for page, expected in zip(found, truth, strict=True):
        np.testing.assert_allclose(page.box_px, expected, rtol=1e-6)


def test_forgotten_tracks_stay_in_the_pages_that_are_not_settled():
    ledger = Ledger(3, False)
    for look in range(3):
        ledger.write(look + 1, np.array([4]), np.array([box(4, look)]), np.ones(1) * 0.9, np.zeros(1, int), None)
    assert ledger.confirmed(np.array([4, 6])).tolist() == [True, False]
    ledger.forget(np.array([4, 6]))
    assert names(ledger.settle(everything=True)) == [[1], [1], [1]]


def test_what_is_kept_does_not_grow_with_the_length_of_a_run():
    """Sightings, pages and steps are dropped once nothing can ask for them."""
    ledger = Ledger(3, True)
    sizes = []
    for look in range(400):
        numbers = np.array([0, 1 + look // 4])
        boxes = np.array([box(0, look), box(1, look)])
        ledger.write(look + 1, numbers, boxes, np.full(2, 0.9), np.arange(2), PAN)
        ledger.settle()
        if look in (199, 399):
            sizes.append((len(ledger.past), sum(map(len, ledger.past.values())), len(ledger.pages), len(ledger.steps)))
    assert sizes[0] == sizes[1]


def test_the_names_of_tracks_that_are_gone_are_not_kept():
    ledger = Ledger(3, True)
    for look in range(300):
        ledger.write(look + 1, np.array([look]), np.array([box(0, 0)]), np.ones(1), np.zeros(1, int), None)
        ledger.forget(np.array([look]))
        pages = ledger.settle()
        assert [p.identity.tolist() for p in pages] == [[p.frame] for p in pages]
        assert max(len(ledger.sure), len(ledger.identities), len(ledger.counts), len(ledger.gone)) < 30


@pytest.mark.parametrize(("hits", "moving"), [(30, False), (60, False), (60, True)])
def test_many_hits_to_confirm_do_not_spoil_the_smoothing(hits, moving):
    ledger, found, truth = Ledger(hits, True), [], []
    for look in range(100):
        truth.append(np.array([box(0, look)]) + np.array([0, 5 * np.sin(look / 10), 0, 0]))
        step = np.eye(3) if moving else None
        ledger.write(look + 1, np.zeros(1, int), truth[-1], np.full(1, 0.9), np.zeros(1, int), step)
        found += ledger.settle()
    found += ledger.settle(everything=True)
    for page, expected in zip(found, truth, strict=True):
        np.testing.assert_allclose(page.box_px, expected, atol=4)
