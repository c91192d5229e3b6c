"""From tables to places: identities, one origin for all cameras, and the fusion of what several of them see."""

from dataclasses import replace

import numpy as np
import pytest

from tests.airborne import within_95
from tests.geo.test_ranging import erring, with_noise
from tests.upright import boxes, camera, poses
from torchvision_dddas.config import GroundParameters, load_config
from torchvision_dddas.errors import InputError
from torchvision_dddas.geo import ground_locator
from torchvision_dddas.geo.ground_locator import GroundLocator, associate, estimate_places, fuse, gate_distance
from torchvision_dddas.geo.ranging import range_people
from torchvision_dddas.geometry import lonlat
from torchvision_dddas.types import DetectionTable, Sightings

WALKERS = np.array([[-1.0, 10.0], [2.0, 14.0]])


def team_of_two():
    near = {"position_sigma_m": 0.1, "heading_sigma_rad": 0.005}
    return camera(**near), camera(heading_rad=np.pi / 2, place=(-15.0, 12.0), **near)


ORIGIN = (-110.95, 32.23)


def walked(frame):
    return WALKERS + np.array([0, 0.1 * frame])


def table(cam, place=(0.0, 0.0), frames=(1, 2, 3), identity=(5, 9)):
    """Two walkers who go north by 0.1 m a frame."""
    n = len(WALKERS) * len(frames)
    box = np.concatenate([boxes(walked(frame), 1.75, cam, place) for frame in frames])
    score, line, identities = np.linspace(0.5, 1, n), np.arange(n) + 1, np.tile(identity, len(frames))
    return DetectionTable("tracks.csv", np.repeat(frames, len(WALKERS)), box, score, line, identity=identities)


def found(tables, cameras, *overrides):
    return list(GroundLocator(cameras, settings=load_config(overrides=overrides)).locate_tables(tables))


def test_one_camera_keeps_the_identities_of_its_table():
    looks = found([table(camera())], [camera()])
    assert [look.frame for look in looks] == [1, 2, 3]
    for look in looks:
        assert look.positions.target.tolist() == [5, 9]
        assert np.allclose(look.positions.east_north_m, walked(look.frame), atol=1e-6)
        assert look.positions.origin_deg is None and look.positions.lonlat_deg is None


def test_an_identity_twice_in_a_frame_is_refused_with_its_line():
    twice = replace(table(camera()), identity=np.array([5, 9, 5, 5, 5, 9]))
    with pytest.raises(InputError, match=r"line 4: identity 5 occurs twice in frame 2; wanted each identity once"):
        found([twice], [camera()])


def test_two_cameras_are_one_team_whose_people_keep_their_numbers():
    south, west = team_of_two()
    tables = [table(south), table(west, west.place, identity=(40, 30))]
    # The second camera's table has its people the other way round in one frame.
    order = [0, 1, 3, 2, 4, 5]
    tables[1] = replace(tables[1], box_px=tables[1].box_px[order], identity=np.array([40, 30, 30, 40, 40, 30]))
    looks = found(tables, [south, west])
    assert [look.positions.target.tolist() for look in looks] == [[1, 2]] * 3
    for look in looks:
        assert (look.members >= 0).all() and look.vehicle.tolist() == [0, 0, 1, 1]
        assert np.allclose(look.positions.east_north_m, walked(look.frame), atol=1e-6)
        alone = look.sightings.covariance_m2[look.vehicle == 0]
        assert (np.linalg.det(look.positions.covariance_m2) < np.linalg.det(alone)).all()
    # Frames that are near are one look where asked for.
    tables = [table(south, frames=(1, 11)), table(west, west.place, frames=(3, 13))]
    assert [look.frame for look in found(tables, [south, west])] == [1, 3, 11, 13]
    looks = found(tables, [south, west], "ground.within_frames=2")
    assert [look.frame for look in looks] == [1, 11] and all((look.members >= 0).all() for look in looks)


def test_paper_mode_converts_by_111320_metres_a_degree():
    cam = camera(place=ORIGIN, geographic=True)
    (look, *_) = found([table(cam)], [cam], "ground.mode=paper")
    box = table(cam).box_px[0]
    depth = 1000 * 1.75 / box[3]
    angle = np.arctan((box[0] + box[2] / 2 - 0.5 - 639.5) / 1000)
    north = ORIGIN[1] + depth * np.cos(angle) / 111_320
    east = ORIGIN[0] + depth * np.sin(angle) / (111_320 * np.cos(np.radians(ORIGIN[1])))
    assert np.allclose(look.positions.lonlat_deg[0], (east, north), atol=1e-12)
    with pytest.raises(InputError, match="no covariances, so it cannot fuse 2 cameras"):
        found([table(cam), table(cam)], [cam, cam], "ground.mode=paper")


def test_a_second_camera_at_degrees_is_put_into_the_metres_of_the_first_and_one_in_metres_is_refused():
    there = tuple(lonlat(np.array([[-15.0, 12.0]]), ORIGIN)[0].tolist())
    south, west = (
        replace(one, geographic=True, place=place) for one, place in zip(team_of_two(), (ORIGIN, there), strict=True)
    )
    looks = found([table(south), table(west, (-15.0, 12.0))], [south, west])
    assert np.allclose(looks[0].positions.east_north_m, walked(1), atol=1e-3)
    with pytest.raises(InputError, match="give all in one kind"):
        found([table(south), table(south)], [camera(), south])


def sightings(east_north_m, own=0.01, common=0.0):
    """Sightings of a vehicle whose errors are those given: own variance or covariance, position sigma."""
    places = np.asarray(east_north_m, float).reshape(-1, 2)
    n = len(places)
    camera_m = np.zeros((n, 2, 6))
    camera_m[:, [0, 1], [0, 1]] = common
    own_m2 = np.broadcast_to(own * np.eye(2) if np.ndim(own) == 0 else own, (n, 2, 2))
    return Sightings(places, np.ones(n), np.zeros(n), np.full(n, "both"), own_m2, np.zeros((n, 2)), camera_m)


def test_independent_sightings_are_averaged_by_the_inverse_of_their_covariances():
    first, second = np.array([[1.0, 0.3], [0.3, 0.5]]), np.array([[0.2, 0.0], [0.0, 3.0]])
    _, place, covariance = fuse([sightings([[0, 0]], own=first), sightings([[0.6, 0.4]], own=second)])
    both = np.linalg.inv(np.linalg.inv(first) + np.linalg.inv(second))
    assert np.allclose(covariance, both)
    assert np.allclose(place, both @ np.linalg.inv(second) @ [0.6, 0.4])


@pytest.mark.parametrize(("apart", "people"), [(0.95, 1), (1.05, 2)])
def test_the_gate_is_that_of_three_sigmas(apart, people):
    limit = np.sqrt(gate_distance(3.0) * 0.02)
    assert len(fuse([sightings([[0, 0]]), sightings([[apart * limit, 0]])])[0]) == people


def test_beliefs_worked_out_one_by_one_or_all_at_once_are_the_same(monkeypatch):
    rng = np.random.default_rng(4)
    people = rng.uniform(-4, 4, (7, 2))
    team = [sightings(people + rng.normal(0, 1, 2) + rng.normal(0, 0.2, (7, 2)), 0.05, 1.4) for _ in range(3)]
    at_once = associate(team)
    monkeypatch.setattr(ground_locator, "_MATRICES", 1)
    assert np.array_equal(associate(team), at_once) and (at_once >= 0).all(axis=1).sum() >= 5


def test_each_sighting_is_of_exactly_one_person_whatever_the_order_of_the_vehicles():
    rng = np.random.default_rng(0)
    team = [sightings(rng.uniform(0, 10, (n, 2)), 0.3, 0.5) for n in (4, 0, 6, 5)]
    for ordered in (team, team[::-1]):
        for column, seen in zip(associate(ordered).T, ordered, strict=True):
            assert sorted(column[column >= 0].tolist()) == list(range(len(seen)))


def test_four_vehicles_halve_the_error_of_one_and_say_how_large_it_is():
    rng, alone, fused, inside, wrong = np.random.default_rng(1), [], [], [], 0
    parameters, everybody = GroundParameters(), np.arange(3)
    for scene in range(120):
        people, tall = rng.normal(0, 4, (3, 2)), 1.75 + rng.normal(0, 0.1, 3)
        team = []
        for turn in np.arange(4) * np.pi / 2:
            place, known = 18 * np.array([np.sin(turn), np.cos(turn)]), camera(heading_rad=turn + np.pi)
            box = boxes(people, tall, erring(known, rng), place + rng.normal(0, known.position_sigma_m, 2))
            where = poses(known, 3, place)
            box = with_noise(box, rng, parameters)
            team.append(range_people(box, np.zeros(3, bool), known, where, where.place, parameters))
        alone += [np.linalg.norm(seen.east_north_m - people, axis=1) for seen in team]
        place, joint = estimate_places(team, np.tile(everybody[:, None], 4))
        inside.append(within_95(place - people, joint[everybody, :, everybody]))
        fused.append(np.linalg.norm(place - people, axis=1))
        if scene < 30:
            wrong += {tuple(row) for row in associate(team).tolist()} != {(n,) * 4 for n in range(3)}
    assert np.mean(alone) > 2.0 and np.mean(fused) < 0.5 * np.mean(alone)
    assert 0.92 < np.mean(inside) < 0.98
    assert wrong < 0.15 * 30
