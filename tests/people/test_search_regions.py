"""Where people are searched in a frame."""

import numpy as np
import pytest

from torchvision_dddas.config import PeopleParameters
from torchvision_dddas.people import pyramid
from torchvision_dddas.people.search_regions import ExpectedPeople, Search
from torchvision_dddas.types import People

SIZE = (640, 480)
KNOBS = PeopleParameters(search="regions", rescan_frames=10)


def people(*boxes):
    box_px = np.array(boxes, float).reshape(-1, 4)
    n = len(box_px)
    return People(box_px, np.full(n, 0.9), np.ones(n), np.zeros(n, bool), box_px)


def walking(frame):
    return people(walker(frame))


def walker(frame):
    return (100 + 4.0 * frame, 200, 40, 110)


def searched_everywhere(made):
    return [n for n, plan in made.items() if plan.regions_px is None]


def search_frames(search, found, last):
    """The plans of frames 1 .. last, where `found(frame)` gives the people of each."""
    made = {}
    for frame in range(1, last + 1):
        made[frame] = search.plan(frame, SIZE)
        search.update(frame, found(frame), made[frame])
    return made


def inside(box, region):
    return (box[:2] >= region[:2]).all() and (box[:2] + box[2:] <= region[:2] + region[2:]).all()


def test_a_walker_is_searched_where_expected_and_the_first_frame_everywhere():
    made = search_frames(Search(KNOBS), walking, 30)
    assert searched_everywhere(made) == [1]
    for n in range(2, 31):
        assert len(made[n].regions_px) == 1 and inside(np.array(walker(n)), made[n].regions_px[0])
    assert 0.1 < np.mean([plan.share for plan in made.values()]) < 0.25
    # One record where the share changes, not one a frame.
    (record,) = [a for plan in made.values() for a in plan.adjustments]
    assert (record.frame, record.parameter, record.old) == (2, "people.regions_share", 1.0)
    assert record.cause == "1 person expected" and 0 < record.new < 0.1


@pytest.mark.parametrize("rescan", [1, 2, 10, 17, 60])
def test_a_round_searches_every_level_once_and_no_window_twice(rescan):
    parameters = KNOBS.model_copy(update={"rescan_frames": rescan})
    everywhere = pyramid.everywhere(SIZE, parameters)
    made = search_frames(Search(parameters), walking, 1 + 2 * rescan)
    for begin in (2, 2 + rescan):
        whole = [part for n in range(begin, begin + rescan) for part in made[n].parts if part in everywhere]
        assert sorted(whole, key=str) == sorted(everywhere, key=str)
    for plan in made.values():
        alone = {part.level for part in plan.parts if part in everywhere}
        assert all(part in everywhere for part in plan.parts if part.level in alone)


@pytest.mark.parametrize(("frames", "patience"), [(20, 20), (1, 4)])
def test_a_missed_person_is_expected_for_two_rounds_and_one_detected_once_for_four_frames(frames, patience):
    expected = ExpectedPeople(KNOBS)
    for n in range(1, frames + 1):
        expected.update(n, walking(n))
    for n in range(frames + 1, frames + patience + 2):
        assert len(expected) == 1
        expected.update(n, people())
    assert len(expected) == 0


def windows_of(part):
    across, down = (part.width - 64) // 8 + 1, (part.height - 128) // 8 + 1
    return {(part.level, part.x + 8 * column, part.y + 8 * row) for row in range(down) for column in range(across)}


@pytest.mark.parametrize("share", [0.2, pytest.param(0.01, marks=pytest.mark.slow)])
def test_a_bounded_search_costs_its_share_and_a_round_covers_every_window(share):
    def found(n):
        return people(walker(n), (400, 200, 40, 110)) if n < 15 else people()

    search = Search(KNOBS.model_copy(update={"look_share": share}), lambda n: np.array([[100.0, 150, 60, 90]]))
    everywhere = pyramid.everywhere(SIZE, KNOBS)
    most = share * pyramid.pixels(everywhere)
    rounds = max(10, int(np.ceil(pyramid.pixels(pyramid.tiles(everywhere, most / 2, KNOBS)) / (most / 2))))
    made = search_frames(search, found, 2 * rounds)
    costs = [pyramid.pixels(plan.parts) for plan in made.values()]
    # However little it may cost, one tile and one level of each region are searched.
    least = 2 * 190 * 260 + 200 * 300 + 3 * 0.04 * 2.25 * 640 * 480
    assert max(costs) < 1.5 * most + least and np.mean(costs) < most + least
    for begin in (1, rounds):
        searched = {w for n in range(begin, begin + rounds) for part in made[n].parts for w in windows_of(part)}
        assert searched >= {w for part in everywhere for w in windows_of(part)}


def test_regions_that_cost_nearly_the_whole_picture_are_not_used():
    parameters = PeopleParameters(search="regions", region_margin=5, region_scales=4)
    made = search_frames(Search(parameters), lambda n: people(*((x, 150, 60, 150) for x in range(0, 600, 60))), 3)
    assert searched_everywhere(made) == [1, 2, 3]


def test_with_blobs_alone_only_their_surroundings_are_searched():
    blobs = {1: np.array([[200, 100, 50, 120.0]])}
    search = Search(PeopleParameters(), lambda n: blobs.get(n, np.zeros((0, 4))))
    made = search_frames(search, lambda n: people(), 3)
    assert len(made[1].regions_px) == 1 and 0 < made[1].share < 0.2
    assert all((made[n].share, made[n].parts, len(made[n].regions_px)) == (0, [], 0) for n in (2, 3))


def test_a_blob_explained_by_an_expected_person_is_not_searched_again():
    def blobs(n):
        return np.array([[105 + 4.0 * n, 220, 30, 80], [505 + 4 * n, 220, 30, 80]])

    regions = search_frames(Search(KNOBS, blobs), walking, 6)[6].regions_px
    assert len(regions) == 2
    assert inside(np.array(walker(6)), regions[0]) and inside(blobs(6)[1], regions[1])


def test_when_all_expected_people_are_lost_one_frame_is_searched_everywhere():
    made = search_frames(Search(KNOBS), lambda n: people(*[walker(n), (400, 200, 40, 110)] * (n < 5)), 10)
    assert searched_everywhere(made) == [1, 6]
    (record,) = made[6].adjustments
    assert record.old < 0.2 and (record.new, record.cause) == (1.0, "none of 2 people expected was found")
