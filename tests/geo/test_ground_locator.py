"""From tables to places: looks, identities, one origin for all cameras."""

from dataclasses import replace

import numpy as np
import pytest

from tests.upright import boxes, camera
from torchvision_dddas.config import load_config
from torchvision_dddas.errors import InputError
from torchvision_dddas.geo.ground_locator import GroundLocator
from torchvision_dddas.geometry import lonlat
from torchvision_dddas.types import DetectionTable

SETTINGS = load_config()
WALKERS = np.array([[-1.0, 10.0], [2.0, 14.0]])
NEAR = {"position_sigma_m": 0.1, "heading_sigma_rad": 0.005}
ORIGIN = (-110.95, 32.23)


def walked(frame):
    """Where the walkers are."""
    return WALKERS + np.array([0, 0.1 * frame])


def table(cam, place=(0.0, 0.0), frames=(1, 2, 3), identity=(5, 9)):
    """Two walkers who go north by 0.1 m a frame."""
    parts = [boxes(walked(frame), 1.75, cam, place) for frame in frames]
    n = len(WALKERS) * len(frames)
    return DetectionTable(
        "tracks.csv",
        np.repeat(frames, len(WALKERS)),
        np.concatenate(parts) if parts else np.zeros((0, 4)),
        np.linspace(0.5, 1, n),
        np.arange(n) + 1,
        identity=np.tile(identity, len(frames)),
    )


def found(tables, cameras, poses=None, settings=SETTINGS, rate=None):
    return list(GroundLocator(cameras, settings, poses=poses or (), rate_hz=rate).locate_tables(tables))


def test_one_camera_keeps_the_identities_of_its_table():
    cam = camera()
    looks = found([table(cam)], [cam])
    assert [look.frame for look in looks] == [1, 2, 3]
    for look in looks:
        assert look.positions.target.tolist() == [5, 9]
        assert np.allclose(look.positions.east_north_m, walked(look.frame), atol=1e-6)
        assert look.positions.origin_deg is None and look.positions.lonlat_deg is None


def test_an_identity_twice_in_a_frame_is_said_with_its_line():
    twice = replace(table(camera()), identity=np.array([5, 9, 5, 5, 5, 9]))
    with pytest.raises(InputError, match=r"line 4: identity 5 is there already in frame 2; wanted each once"):
        GroundLocator(camera(), SETTINGS).locate_tables([twice])


def test_two_cameras_are_one_team_whose_people_keep_their_numbers():
    south, west = camera(**NEAR), camera(heading_rad=np.pi / 2, place=(-15.0, 12.0), **NEAR)
    tables = [table(south), table(west, west.place, identity=(40, 30))]
    # The second camera's table has its people the other way round in one frame.
    order = [0, 1, 3, 2, 4, 5]
    tables[1] = replace(tables[1], box_px=tables[1].box_px[order], identity=np.array([40, 30, 30, 40, 40, 30]))
    looks = found(tables, [south, west])
    assert [look.positions.target.tolist() for look in looks] == [[1, 2]] * 3
    for look in looks:
        assert (look.members >= 0).all()
        assert np.allclose(look.positions.east_north_m, walked(look.frame), atol=1e-6)
        alone = look.sightings.covariance_m2[look.vehicle == 0]
        assert (np.linalg.det(look.positions.covariance_m2) < np.linalg.det(alone)).all()
        assert look.vehicle.tolist() == [0, 0, 1, 1]


def test_frames_that_lie_near_are_one_look_where_asked_for():
    south, west = camera(**NEAR), camera(heading_rad=np.pi / 2, place=(-15.0, 12.0), **NEAR)
    tables = [table(south, frames=(1, 11)), table(west, west.place, frames=(3, 13))]
    assert [look.frame for look in found(tables, [south, west])] == [1, 3, 11, 13]
    near = load_config(overrides=["ground.within_frames=2"])
    looks = found(tables, [south, west], settings=near)
    assert [look.frame for look in looks] == [1, 11]
    assert all((look.members >= 0).all() for look in looks)


def test_paper_mode_converts_by_111320_metres_a_degree():
    paper = load_config(overrides=["ground.mode=paper"])
    cam = camera(place=ORIGIN, geographic=True)
    (look, *_) = found([table(cam)], [cam], settings=paper)
    box = table(cam).box_px[0]
    depth = 1000 * 1.75 / box[3]
    angle = np.arctan((box[0] + box[2] / 2 - 0.5 - 639.5) / 1000)
    north = ORIGIN[1] + depth * np.cos(angle) / 111_320
    east = ORIGIN[0] + depth * np.sin(angle) / (111_320 * np.cos(np.radians(ORIGIN[1])))
    assert look.positions.lonlat_deg is not None
    assert np.allclose(look.positions.lonlat_deg[0], (east, north), atol=1e-12)
    with pytest.raises(InputError, match="no covariances to fuse 2 cameras by"):
        found([table(cam), table(cam)], [cam, cam], settings=paper)


def test_cameras_in_degrees_and_in_metres_do_not_mix():
    cam = camera()
    with pytest.raises(InputError, match="give all in one kind"):
        found([table(cam), table(cam)], [cam, replace(cam, geographic=True, place=ORIGIN)])


def test_a_second_camera_at_degrees_is_put_into_the_metres_of_the_first():
    there = tuple(lonlat(np.array([[-15.0, 12.0]]), ORIGIN)[0].tolist())
    south = camera(place=ORIGIN, geographic=True, **NEAR)
    west = camera(heading_rad=np.pi / 2, place=there, geographic=True, **NEAR)
    looks = found([table(south), table(west, (-15.0, 12.0))], [south, west])
    assert np.allclose(looks[0].positions.east_north_m, walked(1), atol=1e-3)
