"""Several vehicles, one crowd: who is who, and where all sightings together put it."""

import numpy as np
import pytest

from tests.upright import boxes, camera, poses
from torchvision_dddas.config import GroundParameters
from torchvision_dddas.geo import ground_locator
from torchvision_dddas.geo.ground_locator import associate, estimate_places, fuse, gate_distance
from torchvision_dddas.geo.ranging import range_people
from torchvision_dddas.types import Sightings

KNOBS = GroundParameters()


def sightings(east_north_m, own=0.01, common=None, body=None):
    """Sightings of a vehicle whose errors are those given: own variance, position sigma, sigma by the body's height."""
    places = np.asarray(east_north_m, float).reshape(-1, 2)
    n = len(places)
    camera_m = np.zeros((n, 2, 6))
    camera_m[:, [0, 1], [0, 1]] = common or 0.0
    own_m2 = np.broadcast_to(np.asarray(own) * np.eye(2) if np.ndim(own) == 0 else own, (n, 2, 2))
    body_m = np.zeros((n, 2)) if body is None else np.broadcast_to(np.asarray(body, float), (n, 2))
    return Sightings(places, np.ones(n), np.zeros(n), np.full(n, "both"), own_m2, body_m, camera_m)


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
    together_at_once = associate(team)
    monkeypatch.setattr(ground_locator, "_MATRICES", 1)
    assert np.array_equal(associate(team), together_at_once)
    assert (together_at_once >= 0).all(axis=1).sum() >= 5


def test_each_sighting_is_of_exactly_one_person_whatever_the_order_of_the_vehicles():
    rng = np.random.default_rng(0)
    team = [sightings(rng.uniform(0, 10, (n, 2)), 0.3, 0.5) for n in (4, 0, 6, 5)]
    for way in ([0, 1, 2, 3], [3, 2, 1, 0]):
        members = associate([team[v] for v in way])
        for column, v in zip(members.T, way, strict=True):
            assert sorted(column[column >= 0].tolist()) == list(range(len(team[v])))


def test_four_vehicles_halve_the_error_of_one_and_say_how_large_it_is():
    rng, alone, fused, inside, wrong = np.random.default_rng(1), [], [], [], 0
    for scene in range(150):
        people, tall = rng.normal(0, 4, (3, 2)), 1.75 + rng.normal(0, 0.1, 3)
        team = []
        for turn in np.arange(4) * np.pi / 2:
            place = 18 * np.array([np.sin(turn), np.cos(turn)])
            known = camera(heading_rad=turn + np.pi)
            true = camera(
                heading_rad=known.heading_rad + rng.normal(0, known.heading_sigma_rad),
                pitch_rad=rng.normal(0, known.pitch_sigma_rad),
                height_m=1.2 + rng.normal(0, known.height_sigma_m),
                focal_px=(1000 * (1 + rng.normal(0, known.focal_sigma)),) * 2,
            )
            box = boxes(people, tall, true, place + rng.normal(0, known.position_sigma_m, 2))
            height = box[:, 3].copy()
            feet = box[:, 1] + height + rng.normal(0, 1, 3) * np.hypot(KNOBS.feet_sigma * height, 0.5)
            box[:, 0] += rng.normal(0, 1, 3) * np.hypot(KNOBS.feet_sigma * height, 0.5)
            box[:, 3] += rng.normal(0, 1, 3) * np.hypot(KNOBS.height_sigma * height, 0.5)
            box[:, 1] = feet - box[:, 3]
            where = poses(known, 3, place)
            team.append(range_people(box, np.zeros(3, bool), known, where, where.place, KNOBS))
        alone += [np.linalg.norm(seen.east_north_m - people, axis=1) for seen in team]
        same = np.tile(np.arange(3)[:, None], 4)
        found, joint = estimate_places(team, same)
        off = found - people
        own = joint[np.arange(3), :, np.arange(3)]
        inside.append(np.einsum("ni,nij,nj->n", off, np.linalg.inv(own), off) < 5.991)
        fused.append(np.linalg.norm(off, axis=1))
        if scene < 30:
            wrong += {tuple(row) for row in associate(team).tolist()} != {(n,) * 4 for n in range(3)}
    assert np.mean(alone) > 2.0
    assert np.mean(fused) < 0.5 * np.mean(alone)
    assert 0.92 < np.mean(inside) < 0.98
    assert wrong < 0.15 * 30
