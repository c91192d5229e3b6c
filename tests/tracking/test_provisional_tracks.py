"""`Tracker(lag=0)`: tracks of the same frame, which the settled tracks of the frame confirm or correct later."""

import numpy as np
import pytest

from torchvision_dddas.config import Settings, load_config, with_parameters
from torchvision_dddas.errors import InputError
from torchvision_dddas.tracking import Tracker
from torchvision_dddas.types import Tracks

SIZE = (640, 480)


def crowd(frames: int = 60, people: int = 12) -> list[tuple[np.ndarray, np.ndarray]]:
    """Boxes and scores of people who cross each other's ways, with missed and false detections."""
    rng = np.random.default_rng(5)
    place, speed = rng.uniform((60, 60), (580, 420), (people, 2)), rng.normal(0, 4, (people, 2))
    given = []
    for _ in range(frames):
        place = place + speed
        seen = place[rng.random(people) > 0.1] + rng.normal(0, 1.5, (1, 2))
        stray = rng.uniform((60, 60), (580, 420), (rng.poisson(0.5), 2))
        corners = np.concatenate([seen, stray])
        boxes = np.concatenate([corners, np.tile([14.0, 36.0], (len(corners), 1))], axis=1)
        order = rng.permutation(len(boxes))
        given.append((boxes[order], rng.uniform(0.6, 0.95, len(boxes))))
    return given


def run(lag: int | None, settings: Settings | None = None, image: np.ndarray | None = None) -> list[list[Tracks]]:
    tracker = Tracker(settings, size=SIZE, lag=lag)
    return [*(tracker.update(each, image=image) for each in crowd()), tracker.flush()]


@pytest.mark.parametrize("changes", [{}, {"track.look_ahead": False}, {"track.hits": 1, "track.smooth": False}])
@pytest.mark.parametrize("is_pictured", [False, True])
def test_provisional_tracks_come_with_their_frame_and_change_no_settled_track(changes, is_pictured) -> None:
    settings = with_parameters(load_config(), changes)
    image = np.random.default_rng(1).integers(0, 255, (480, 640, 3), np.uint8) if is_pictured else None
    now, usual = run(0, settings, image), [tracks for each in run(None, settings, image) for tracks in each]
    assert [each[-1].frame for each in now[:-1]] == list(range(1, 61))
    assert all(each[-1].provisional for each in now[:-1])
    settled = [tracks for each in now for tracks in each if not tracks.provisional]
    assert len(settled) == len(usual) == 60
    names: dict[int, int] = {}
    for one, other in zip(settled, usual, strict=True):
        assert np.array_equal(one.box_px, other.box_px) and np.array_equal(one.row, other.row)
        assert np.array_equal(one.link, other.link, equal_nan=True)
        assert repr(one.appearance) == repr(other.appearance), "by text, as NaN is unequal to itself"
        for name, known in zip(one.identity.tolist(), other.identity.tolist(), strict=True):
            assert names.setdefault(name, known) == known
    assert len(set(names.values())) == len(names)


def test_settled_tracks_name_the_provisional_identities_that_they_correct() -> None:
    told, corrected, kept = dict[int, Tracks](), 0, 0
    for tracks in (tracks for each in run(0) for tracks in each):
        if tracks.provisional:
            told[tracks.frame] = tracks
            assert tracks.corrects == ()
            continue
        before = told.pop(tracks.frame)
        rows = dict(zip(tracks.identity.tolist(), tracks.row.tolist(), strict=True))
        for name, row in zip(before.identity.tolist(), before.row.tolist(), strict=True):
            assert (name in tracks.corrects) == (rows.get(name) != row)
        corrected, kept = corrected + len(tracks.corrects), kept + len(before) - len(tracks.corrects)
    assert told == {} and 0 < corrected < 0.2 * kept


def test_a_provisional_track_has_the_box_score_and_class_of_its_detection_at_once() -> None:
    tracker = Tracker(size=SIZE, lag=0)
    (tracks,) = tracker.update((np.array([[10.0, 20, 30, 40]]), np.array([0.7])), frame=8)
    assert (tracks.frame, tracks.provisional, tracks.id.tolist(), tracks.label.tolist()) == (8, True, [1], [""])
    assert np.array_equal(tracks.box_px, [[10, 20, 30, 40]]) and tracks.score.tolist() == [0.7]
    (nothing,) = tracker.update(np.zeros((0, 4)))
    assert (nothing.frame, nothing.provisional, len(nothing)) == (9, True, 0)


def test_the_sources_association_settles_each_frame_at_once_so_nothing_is_provisional() -> None:
    tracker = Tracker(with_parameters(load_config(), {"track.mode": "paper"}), size=SIZE, lag=0)
    found = [tracks for each in crowd(8) for tracks in tracker.update(each)]
    assert [tracks.frame for tracks in found] == list(range(1, 9))
    assert not any(tracks.provisional for tracks in found)


@pytest.mark.parametrize("lag", [1, -1, 0.5, "now", False])
def test_another_lag_is_refused(lag) -> None:
    with pytest.raises(InputError, match="lag must be 0"):
        Tracker(lag=lag)
