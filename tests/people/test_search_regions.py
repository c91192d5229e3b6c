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


def walker(frame, x=100.0, speed=4.0):
    return (x + speed * frame, 200, 40, 110)


def looks(search, found, last, first=1):
    """The looks at frames first .. last, where `found(frame)` is what each finds."""
    made = {}
    for frame in range(first, last + 1):
        made[frame] = search.plan(frame, SIZE)
        search.update(frame, found(frame), made[frame])
    return made


def inside(box, region):
    return (box[:2] >= region[:2]).all() and (box[:2] + box[2:] <= region[:2] + region[2:]).all()


def test_a_walker_is_searched_for_where_he_will_be_and_the_first_look_is_at_all():
    made = looks(Search(KNOBS), lambda n: people(walker(n)), 30)
    assert [n for n, look in made.items() if look.regions_px is None] == [1]
    for n in range(2, 31):
        assert len(made[n].regions_px) == 1 and inside(np.array(walker(n)), made[n].regions_px[0])
    assert 0.1 < np.mean([look.share for look in made.values()]) < 0.25


@pytest.mark.parametrize("rescan", [1, 2, 3, 10, 17, 60])
def test_every_level_has_its_turn_once_in_a_round_and_no_window_is_searched_twice(rescan):
    parameters = KNOBS.model_copy(update={"rescan_frames": rescan})
    everywhere = pyramid.everywhere(SIZE, parameters)
    made = looks(Search(parameters), lambda n: people(walker(n)), 1 + 2 * rescan)
    for begin in (2, 2 + rescan):
        whole = [part for n in range(begin, begin + rescan) for part in made[n].parts if part in everywhere]
        assert sorted(whole, key=str) == sorted(everywhere, key=str)
    for look in made.values():
        alone = {part.level for part in look.parts if part in everywhere}
        assert all(part in everywhere for part in look.parts if part.level in alone)


def test_one_who_is_missed_stays_expected_for_two_rounds_and_a_glimpse_is_soon_forgotten():
    expected = ExpectedPeople(KNOBS)
    for n in range(1, 21):
        expected.update(n, people(walker(n)))
    for n in range(21, 41):
        expected.update(n, people())
        assert len(expected) == 1
    expected.update(41, people())
    assert len(expected) == 0
    expected.update(42, people(walker(42)))
    for n in range(43, 47):
        expected.update(n, people())
        assert len(expected) == 1
    expected.update(47, people())
    assert len(expected) == 0


@pytest.mark.parametrize("share", [0.2, pytest.param(0.01, marks=pytest.mark.slow)])
def test_a_bounded_look_takes_its_share_and_a_round_of_them_searches_every_window(share):
    def found(n):
        return people(walker(n), (400, 200, 40, 110)) if n < 15 else people()

    search = Search(KNOBS.model_copy(update={"look_share": share}), lambda n: np.array([[100.0, 150, 60, 90]]))
    everywhere = pyramid.everywhere(SIZE, KNOBS)
    most = share * pyramid.pixels(everywhere)
    rounds = max(10, int(np.ceil(pyramid.pixels(pyramid.tiles(everywhere, most / 2, KNOBS)) / (most / 2))))
    made = looks(search, found, 2 * rounds)
    costs = [pyramid.pixels(look.parts) for look in made.values()]
    # However little it may cost, one tile and one level of each region are searched.
    least = 2 * 190 * 260 + 200 * 300 + 3 * 0.04 * 2.25 * 640 * 480
    assert max(costs) < 1.5 * most + least
    assert np.mean(costs) < most + least
    for begin in (1, rounds):
        seen = {w for n in range(begin, begin + rounds) for part in made[n].parts for w in windows_of(part)}
        assert seen >= {w for part in everywhere for w in windows_of(part)}


def windows_of(part):
    across, down = (part.width - 64) // 8 + 1, (part.height - 128) // 8 + 1
    return {(part.level, part.x + 8 * column, part.y + 8 * row) for row in range(down) for column in range(across)}


def test_the_record_has_a_line_where_the_share_changes_and_not_one_a_frame():
    made = looks(Search(KNOBS), lambda n: people(walker(n)), 110)
    lines = [a for look in made.values() for a in look.adjustments]
    assert [(a.frame, a.parameter, a.old, a.cause) for a in lines] == [
        (2, "people.regions_share", 1.0, "1 person expected")
    ]
    assert 0 < lines[0].new < 0.1


def test_regions_that_would_cost_nearly_all_are_given_up_for_the_whole_picture():
    parameters = PeopleParameters(search="regions", region_margin=5, region_scales=4)
    made = looks(Search(parameters), lambda n: people(*((x, 150, 60, 150) for x in range(0, 600, 60))), 3)
    assert all(look.regions_px is None for look in made.values())


def test_with_blobs_alone_only_their_surroundings_are_searched_and_nothing_where_there_are_none():
    blobs = {1: np.array([[200, 100, 50, 120.0]])}
    made = looks(Search(PeopleParameters(), lambda n: blobs.get(n, np.zeros((0, 4)))), lambda n: people(), 25)
    assert len(made[1].regions_px) == 1 and 0 < made[1].share < 0.2
    assert all(look.share == 0 and look.parts == [] and len(look.regions_px) == 0 for n, look in made.items() if n > 1)


def test_a_blob_that_those_expected_explain_is_not_searched_again():
    blob = np.array([[0, 220, 30, 80.0], [400, 220, 30, 80]])

    def blobs(n):
        return blob + np.array([4.0 * n + 105, 0, 0, 0])

    search = Search(KNOBS, blobs)
    made = looks(search, lambda n: people(walker(n)), 6)
    assert len(made[6].regions_px) == 2
    assert inside(np.array(walker(6)), made[6].regions_px[0])
    assert inside(blobs(6)[1], made[6].regions_px[1])


def test_a_frame_is_searched_everywhere_once_when_all_who_were_expected_are_lost():
    def found(n):
        return people(walker(n), (400, 200, 40, 110)) if n < 5 else people()

    made = looks(Search(KNOBS), found, 10)
    assert [n for n, look in made.items() if look.regions_px is None] == [1, 6]
    assert [(a.old < 0.2, a.new, a.cause) for a in made[6].adjustments] == [
        (True, 1.0, "none of 2 people expected was found")
    ]
