"""The public classes over whole clips: the pipeline on frames, and locating by records alone."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from torchvision_dddas.config import Settings, with_parameters
from torchvision_dddas.errors import InputError
from torchvision_dddas.geo import AerialLocator
from torchvision_dddas.geo.ground_locator import GroundLocator
from torchvision_dddas.pipeline import Pipeline
from torchvision_dddas.types import Camera, Detections, Frame, People, Registration, Scene, Telemetry, Tracks

CAMERA = Camera("uav", (640, 480), (554.0, 554.0), (319.5, 239.5))
DOWN = Telemetry(
    np.array([0.0, 10.0]),
    np.array([50.0, 50.0]),
    np.zeros(2),
    place=np.array([[5.0, 7.0], [5.0, 7.0]]),
    geographic=False,
    heading_rad=np.zeros(2),
    pitch_rad=np.full(2, np.pi / 2),
    roll_rad=np.zeros(2),
)


@pytest.fixture(scope="module")
def frames():
    """A square that moves over noise."""
    rng = np.random.default_rng(0)
    ground = rng.integers(0, 255, (160, 240, 3), np.uint8)
    made = []
    for n in range(14):
        image = ground.copy()
        image[60:80, 40 + 4 * n : 60 + 4 * n] = (0, 0, 255)
        made.append(image)
    return made


def test_a_source_and_single_frames_give_the_same_results(frames):
    settings = with_parameters(Settings(), {"gates.min_area_px": 40})
    called = list(Pipeline(settings)(frames))
    pipeline = Pipeline(settings)
    fed = [result for image in frames for result in pipeline.update(image)]
    fed += pipeline.flush()
    assert [r.number for r in called] == list(range(1, 15))
    for one, other in zip(called, fed, strict=True):
        np.testing.assert_array_equal(one.tracks.id, other.tracks.id)
        np.testing.assert_array_equal(one.tracks.xyxy, other.tracks.xyxy)
    assert any(len(r.tracks) for r in called)


def test_frames_are_located_where_telemetry_says_where_the_camera_is(frames):
    camera = Camera("uav", (240, 160), (200.0, 200.0), (119.5, 79.5))
    results = list(Pipeline(None, telemetry=DOWN, camera=camera)(Frame(n, n / 10, f) for n, f in enumerate(frames, 1)))
    assert all(r.locations is not None and r.locations.fix.by == "telemetry" for r in results)


def test_a_pipeline_takes_what_the_telemetry_lacks_from_the_camera(frames):
    blind = replace(DOWN, heading_rad=np.full(2, np.nan), pitch_rad=np.full(2, np.nan))
    bare = Camera("uav", (240, 160), (200.0, 200.0), (119.5, 79.5))
    for camera, by in ((bare, ""), (replace(bare, heading_rad=1.0, pitch_rad=1.2), "telemetry")):
        pipeline = Pipeline("fast", telemetry=blind, camera=camera)
        assert {result.locations.fix.by for result in pipeline(frames) if result.locations is not None} == {by}
    assert any("heading_deg, pitch_deg" in note for note in pipeline.notes)


@pytest.mark.parametrize("late_s", [0.0, 0.5])
def test_a_log_that_is_not_synchronised_with_the_clip_is_noted_after_the_last_frame(monkeypatch, late_s):
    time_s = np.arange(120) / 10
    heading = 0.3 * np.sin(time_s / 1.3) + 0.2 * np.sin(time_s / 0.7)
    still, place = np.zeros(120), np.tile([5.0, 7.0], (120, 1))
    turned: Any = {"heading_rad": heading % (2 * np.pi), "pitch_rad": still + np.pi / 2, "roll_rad": still}
    log = Telemetry(time_s - late_s, still + 50, still, place, False, **turned)

    class Clip:
        rate_hz, size = 10.0, CAMERA.size_px

        def __iter__(self):
            return (Frame(n, (n - 1) / 10, np.zeros((480, 640, 3), np.uint8)) for n in range(1, 121))

    def scenes(source, *_, **__):
        for frame, turn in zip(source, np.diff(heading, prepend=heading[0]), strict=True):
            # Straight down the picture turns against the camera's heading.
            way = np.array([[np.cos(turn), np.sin(turn), 0], [-np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
            middle = np.array([[1, 0, 319.5], [0, 1, 239.5], [0, 0, 1]])
            step = Registration(middle @ way @ np.linalg.inv(middle), 99, 99, 0.1, 1.0)
            none = Detections(np.zeros((0, 4)), *np.zeros((4, 0)))
            yield Scene(frame, np.zeros((480, 640), np.uint16), none, 1, step=step if frame.number > 1 else None)

    monkeypatch.setattr("torchvision_dddas.pipeline.detect_motion", scenes)
    pipeline = Pipeline(None, telemetry=log, camera=CAMERA)
    results = list(pipeline(Clip()))
    assert len(results) == 120
    said = [note for note in pipeline.notes if "not synchronised" in note]
    assert len(said) == bool(late_s)
    assert all(float(note.split("clock_offset_s=")[1]) == pytest.approx(late_s, abs=0.02) for note in said)


WRONG: Any = "flight.csv"  # where a record is wanted
LIST: Any = [5]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Pipeline(interval=0), "interval must be at least 1"),
        (lambda: Pipeline("no_such"), "no_such"),
        (lambda: Pipeline(telemetry=WRONG), "telemetry must be of type Telemetry, got str"),
        (lambda: Pipeline(camera=CAMERA), "of no use without landmarks"),
        (lambda: Pipeline()(LIST[0]), "wants a path or frames, got int"),
        (lambda: Pipeline().update(WRONG), "must be a Frame or a NumPy image, got str"),
        (lambda: list(Pipeline()([np.zeros((8, 8, 3))] * 4)), "must be uint8"),
        (lambda: AerialLocator(CAMERA), "landmarks, or telemetry"),
        (lambda: AerialLocator(CAMERA, WRONG), "got str where a Telemetry is wanted"),
        (lambda: AerialLocator(CAMERA, DOWN, rate_hz=0), "rate_hz must be positive"),
        (lambda: AerialLocator(CAMERA, DOWN).locate(LIST), "wants Tracks or a TrackedFrame, got list"),
        (lambda: GroundLocator([]), "wants one Camera or several"),
        (lambda: GroundLocator(CAMERA).locate([WRONG]), "wants the People of each camera"),
    ],
)
def test_what_cannot_be_used_is_one_clear_line(make, message):
    with pytest.raises(InputError, match=message):
        make()


def test_telemetry_without_places_locates_nothing_and_says_so(frames):
    pipeline = Pipeline(telemetry=replace(DOWN, place=np.full((2, 2), np.nan)))
    assert pipeline.notes == [
        "nothing is located: the telemetry holds no place of the vehicle, and there are no landmarks"
    ]
    assert all(result.locations is None for result in pipeline(frames))


def test_tracks_are_located_by_telemetry_alone():
    tracks = Tracks(1, np.array([3]), np.array([[315.0, 235.0, 10, 10]]), np.ones(1), np.zeros(1, np.int64))
    found = AerialLocator(CAMERA, DOWN).locate(tracks)
    np.testing.assert_allclose(found.positions.east_north_m, [[5.0, 7.0]], atol=0.1)
    assert found.positions.target.tolist() == [3]


def test_people_are_located_by_a_camera_alone():
    camera = Camera("ugv", (640, 480), (500.0, 500.0), (319.5, 239.5), height_m=1.2)
    people = People(
        np.array([[310.0, 200, 20, 85.0]]),
        np.ones(1),
        np.ones(1),
        np.zeros(1, bool),
        np.array([[310.0, 200, 20, 85.0]]),
    )
    found = GroundLocator(camera).locate(people)
    assert found.positions.east_north_m[0, 1] == pytest.approx(10.1, abs=1.5)
