"""A scenario that runs: reproducible, steered, true to its faults, as a source of frames, on film and on disk."""

import csv
import json
from functools import cache
from itertools import takewhile

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from tests.lab.simulation.small import as_file, bodies_at, small
from torchvision_dddas import open_video
from torchvision_dddas.cli import app
from torchvision_dddas.errors import InputError
from torchvision_dddas.io.ground_tables import read_positions
from torchvision_dddas.lab.evaluation.metrics import truth as read
from torchvision_dddas.lab.simulation import SimulatorSource, film, film_clip, load_scenario
from torchvision_dddas.lab.simulation.simulator import Simulator
from torchvision_dddas.lab.simulation.truth import TruthOutput
from torchvision_dddas.lab.simulation.world import build_world
from torchvision_dddas.types import CameraPose, Command, Elevation, Order, Truth


def shots(simulator, command=None):
    """All of a run; command: given after the first shot."""
    simulator.restart()
    found = [simulator.next()]
    if command:
        simulator.steer(command)
    return [*found, *iter(simulator.next, None)]


@cache
def plain():
    simulator = Simulator(small())
    return simulator, tuple(shots(simulator))


def test_an_order_moves_its_vehicle_and_pictures_from_the_ground_change_nothing():
    simulator, run = plain()
    goal = run[0].moments[-1].reported_lonlat_deg[0] + (0.0, 5e-4)
    far = shots(simulator, Command(orders=(Order("ugv1", goal, 3.0),)))[-1].truth.bodies
    own = np.flatnonzero(far.kind == "ugv")[0]
    assert far.place_m[own, 1] - run[0].truth.bodies.place_m[own, 1] > 1.0
    simulator.restart()
    for shot in run[:3]:
        simulator.picture("ugv1")
        np.testing.assert_array_equal(simulator.next().frame.image, shot.frame.image)
    with pytest.raises(InputError, match="no ground vehicle is named 'ugv9'; there are ugv1, ugv2, ugv3, ugv4"):
        simulator.steer(Command(orders=(Order("ugv9", np.zeros(2), 1.0),)))


def test_a_frozen_camera_repeats_its_picture_while_the_world_goes_on():
    run = shots(Simulator(small(seed=4, fault=({"what": "frozen", "time_s": 0.5, "seconds": 0.45},))))
    for shot in run[5:9]:
        np.testing.assert_array_equal(shot.frame.image, run[4].frame.image)
    assert not np.array_equal(run[10].frame.image, run[4].frame.image)
    assert np.abs(run[8].truth.bodies.place_m - run[4].truth.bodies.place_m)[:, :2].max() > 0.05
    other = plain()[1][0].frame.image.astype(int)
    assert np.abs(run[0].frame.image - other).mean() > 2  # another seed is another run


def test_a_way_below_what_stands_there_is_refused(monkeypatch):
    world = build_world(small().world, 3)
    row, column = (int(v / world.surface_texel_m) for v in (30.0, 35.0))
    world.surface[row - 2 : row + 3, column - 2 : column + 3] = 12.0  # a tower at [5, 0]
    monkeypatch.setattr("torchvision_dddas.lab.simulation.simulator.build_world", lambda *_: world)
    with pytest.raises(InputError, match=r"uav.altitude_m = 12.5 is too low: the object at \[\d+, 0\] is 12.0 m high"):
        Simulator(small(uav={"altitude_m": 12.5, "way_m": ((10.0, 0.0),)}))
    Simulator(small(uav={"altitude_m": 13.5, "way_m": ((10.0, 0.0),)}))
    Simulator(small(uav={"altitude_m": 12.5, "way_m": ((-10.0, 0.0),)}))


def test_an_altitude_below_the_terrain_in_view_is_refused():
    east = np.arange(-40, 41, 2.0)
    ridge = np.tile(20 * np.exp(-((east / 4) ** 2)) - 20.0, (len(east), 1))
    hills = Elevation(ridge, (-40.0, -40.0), 2.0, 1300.0)
    aslant = {"altitude_m": 10.0, "pitch_deg": 45.0, "heading_deg": 90.0, "start_m": (5.0, 0.0)}
    with pytest.raises(InputError, match="altitude_m = 10 is too low for the terrain in view"):
        Simulator(small(uav=aslant), elevation=hills)
    Simulator(small(uav={**aslant, "start_m": (-15.0, 0.0)}), elevation=hills)


# As a source.


@pytest.fixture(scope="module")
def source():
    return SimulatorSource(small(fault=({"what": "dropped", "time_s": 0.5, "seconds": 0.15},)), "small")


def until(source, last):
    """The frames up to a number."""
    return list(takewhile(lambda frame: frame.number <= last, source))


def test_a_source_leaves_out_the_numbers_of_dropped_frames(source):
    assert [f.number for f in source] == [n for n in range(1, 21) if n not in (6, 7)]
    assert (source.name, source.count, source.exact, source.rate_hz) == ("small", 20, True, 10.0)
    assert (source.size, source.last) == ((160, 120), 20)
    assert [str(p) for p in source.problems] == [f"frame {n} was dropped by the camera" for n in (6, 7)]
    # Truths come once for every frame, dropped ones too.
    assert [t.frame for t in source.truths()] == list(range(1, 21))
    assert source.truths() == []
    # Of two plans for one frame the newer counts.
    landmarks = source.landmarks()
    plans = [(k, f) for k, f, p in zip(landmarks.landmark, landmarks.frame, landmarks.planned, strict=True) if p]
    assert len(plans) == len(set(plans)) > 0
    assert (np.diff(landmarks.frame) >= 0).all()


def test_every_iteration_starts_anew(source):
    first = until(source, 4)
    reports, flown = source.landmarks(), source.telemetry()
    for a, b in zip(first, until(source, 4), strict=True):
        np.testing.assert_array_equal(a.image, b.image)
    np.testing.assert_array_equal(source.landmarks().place, reports.place)
    np.testing.assert_array_equal(source.telemetry().place, flown.place)
    assert source.problems == []
    some = {f.number: f.image for f in source.every(3)}
    assert list(some) == [1, 4, 10, 13, 16, 19]
    np.testing.assert_array_equal(some[4], first[3].image)


def test_commands_leave_frames_out_and_order_single_pictures(source):
    seen, pictures = [], []
    for frame in source:
        seen.append((frame.number, frame.skipped))
        pictures += [(frame.number, picture.vehicle) for picture in source.pictures()]
        if frame.number == 2:
            here = source.landmarks().place[:2]
            orders = (Order("ugv1", here[0], 0.0, picture=True), Order("ugv3", here[1], 0.0))
            source.steer(Command(every=3, orders=orders))
        if frame.number == 14:
            source.steer(Command())
    # 6 and 7 were dropped by the camera.
    assert seen == [(1, 0), (2, 0), (5, 2), (8, 2), (11, 2), (14, 2), *((n, 0) for n in range(15, 21))]
    assert pictures == [(5, "ugv1")]


def test_open_video_takes_a_scenarios_name_or_file(tmp_path):
    source = open_video(f"sim:{as_file(tmp_path / 'tiny.toml', small())}")
    assert isinstance(source, SimulatorSource)
    assert source.name == "tiny"


@pytest.mark.parametrize(
    ("name", "options", "line"),
    [
        ("sim:nowhere", {}, "no scenario is named 'nowhere'; choose from border100"),
        ("sim:{}/tiny.toml", {"rate_hz": 5}, "leave --rate out"),
        ("sim:{}/low.toml", {}, r"low.toml: uav.altitude_m = 2 is too low"),
        ("sim:{}/odd.toml", {}, "hills.tif cannot be read as a raster"),
    ],
)
def test_a_scenario_that_cannot_be_opened_is_refused(tmp_path, name, options, line):
    if "odd" in name:
        pytest.importorskip("rasterio")
    (tmp_path / "hills.tif").write_bytes(b"no raster")
    as_file(tmp_path / "tiny.toml", small())
    as_file(tmp_path / "odd.toml", small(world={"elevation": "hills.tif"}))
    low = {"altitude_m": 2.0, "way_m": ((25.0, 25.0),)}
    as_file(tmp_path / "low.toml", small(uav=low, world={"trees_per_ha": 500.0}))
    with pytest.raises(InputError, match=line):
        open_video(name.format(tmp_path), **options)


# On film and on disk.


@pytest.mark.slow
def test_a_clip_on_disk_is_the_film_whose_masks_number_what_moves(tmp_path):
    made = list(film(load_scenario("demo"), 1, 2, (160, 120)))
    film_clip(tmp_path, 1, 2, (160, 120))
    assert len(made) == 2
    picture, mask = (cv2.imread(str(tmp_path / name), -1) for name in ("frames/000002.jpg", "masks/000002.png"))
    assert picture is not None and mask is not None
    assert np.abs(picture.astype(int) - made[1][0]).mean() < 3
    assert np.array_equal(mask, made[1][1])
    parked = len(load_scenario("demo").crowd) + 3  # the third car stands
    assert made[0][1].any()
    assert not (made[0][1] == parked).any()


@pytest.mark.slow
def test_the_demo_finds_most_movers_and_leaves_the_parked_car_alone(tmp_path, monkeypatch):
    def short(folder, tick):
        return film_clip(folder, frames=16, size_px=(480, 360))

    monkeypatch.setattr("torchvision_dddas.lab.simulation.film_clip", short)
    result = CliRunner().invoke(app, ["demo", "--out", str(tmp_path / "demo")])
    assert result.exit_code == 0, result.output
    scores = json.loads((tmp_path / "demo/metrics.json").read_text())["clips"]["demo"]
    assert scores["pixels"]["f"] > 0.6
    assert scores["pixels"]["precision"] > 0.6
    assert cv2.VideoCapture(str(tmp_path / "demo/overlay.mp4")).get(cv2.CAP_PROP_FRAME_COUNT) == 16


def truth(frame=1, speeds=(1.0, 1.0, 5.0, 0.5), car=True):
    """Two people of crowd 1, a car (2), a ground vehicle (3)."""
    mask, people = np.zeros((2, 40, 60), np.uint16)
    for rows, columns, target, number in (
        (slice(5, 8), slice(10, 12), 1, 1),
        (slice(9, 12), slice(20, 22), 1, 2),
        (slice(20, 25), slice(30, 40), 2, 5),
        (slice(30, 34), slice(50, 54), 3, 6),
    ):
        if target != 2 or car:
            mask[rows, columns], people[rows, columns] = target, number
    bodies = bodies_at(
        [[0.0, 0, 0], [2, 4, 0], [10, 10, 0], [-5, 5, 0]],
        ["person", "person", "car", "ugv"],
        number=np.array([1, 2, 5, 6]),
        target=np.array([1, 1, 2, 3]),
        velocity_m_s=np.c_[speeds, np.zeros(4)],
    )
    return Truth(frame, (frame - 1) / 10, mask, people, bodies, CameraPose(np.array([0, 0, 50.0]), np.eye(3)))


def degrees(metres):
    return np.asarray(metres) / 1e5 + (-110.0, 31.0)


def written(tmp_path, *truths):
    output = TruthOutput(tmp_path, degrees)
    for item in truths:
        output.write(item)
    output.close(True)
    return tmp_path / "truth"


def numbers(path, count):
    return np.loadtxt(path, delimiter=",", ndmin=2)[:, :count].tolist()


def test_boxes_leave_the_landmarks_out_and_persons_have_their_own_numbers(tmp_path):
    folder = written(tmp_path, truth(1), truth(2, car=False))
    expected = [[1, 1, 10, 5, 12, 7, 1], [1, 2, 30, 20, 10, 5, 1], [2, 1, 10, 5, 12, 7, 1]]
    assert numbers(folder / "gt.txt", 7) == expected
    assert numbers(folder / "people.txt", 6)[:2] == [[1, 1, 10, 5, 2, 3], [1, 2, 20, 9, 2, 3]]


def test_what_stands_is_in_no_mask_and_its_box_does_not_count(tmp_path):
    item = truth(speeds=(0.0, 0.0, 5.0, 1.0))
    item.mask[item.mask == 3] = 700  # masks of many targets keep their numbers
    folder = written(tmp_path, item)
    assert {(row[1], row[6]) for row in numbers(folder / "gt.txt", 7)} == {(1, 0), (2, 1)}
    assert set(np.unique(read.read_mask(folder / "masks" / "000001.png"))) == {0, 2, 700}


def test_the_place_of_a_crowd_is_the_middle_of_its_people_and_the_map_names_landmarks(tmp_path):
    folder = written(tmp_path, truth(1), truth(2, car=False))
    table = list(csv.DictReader((folder / "positions.csv").open()))
    columns = ("kind", "target", "people", "east_m", "north_m", "visible_px")
    crowd, car, vehicle = ([row[name] for name in columns] for row in table[:3])
    assert crowd[:3] == ["person", "1", "2"]
    assert (float(crowd[3]), float(crowd[4])) == (1, 2)
    assert (car[0], car[2], car[5], vehicle[0]) == ("car", "0", "50", "ugv")
    assert table[4]["visible_px"] == "0"  # the car, out of the second picture
    positions = read_positions(folder / "positions.csv")
    assert positions.target.tolist() == [1, 2, 3, 1, 2, 3]
    assert positions.lonlat_deg is not None
    np.testing.assert_allclose(positions.lonlat_deg[0], degrees([1, 2]))
    features = [f["properties"] for f in json.loads((folder / "tracks.geojson").read_text())["features"]]
    assert [(f.get("target"), f.get("landmark")) for f in features] == [(1, None), (2, None), (None, "ugv1")]
    assert (features[0]["frames"], features[0]["seconds"]) == ([1, 2], [0, 0.1])


def test_a_run_that_fails_leaves_no_tables(tmp_path):
    output = TruthOutput(tmp_path, degrees)
    output.write(truth())
    output.discard()
    assert [p.name for p in (tmp_path / "truth").iterdir()] == ["masks"]
