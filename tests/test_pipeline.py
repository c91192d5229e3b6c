"""The public classes over whole clips: the pipeline on frames, and locating by records alone."""

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest

from tests.control.test_ground_team import STANDS, platform
from torchvision_dddas.config import Settings, with_parameters
from torchvision_dddas.errors import InputError
from torchvision_dddas.geo import AerialLocator
from torchvision_dddas.geo.ground_locator import GroundLocator
from torchvision_dddas.pipeline import Pipeline
from torchvision_dddas.pipeline.assembly import view_reach_m
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


def test_a_function_takes_the_place_of_the_motion_detector_and_its_classes_last(frames):
    asked = []

    def detect(frame: Frame) -> Detections:
        asked.append(frame.number)
        box = np.array([[36.0 + 4 * frame.number, 60, 20, 20], [150, 100, 30, 15]])
        return Detections(box, np.array([0.9, 0.8]), label=np.array(["car", "person"], object))

    results = list(Pipeline(detector=detect, interval=2)(frames))
    assert asked == [1, 3, 5, 7, 9, 11, 13] == [result.number for result in results]
    tracks = results[3].tracks
    assert sorted(zip(tracks.label.tolist(), tracks.id.tolist(), strict=True)) == [("car", 1), ("person", 2)]
    pipeline = Pipeline(detector=detect, interval=2)
    fed = [result for image in frames for result in pipeline.update(image)] + pipeline.flush()
    assert [r.tracks.id.tolist() for r in fed] == [r.tracks.id.tolist() for r in results]


def test_what_a_function_returns_instead_of_detections_is_one_line(frames):
    with pytest.raises(InputError, match="returned list for frame 1; return"):
        list(Pipeline(detector=lambda frame: [[1, 2, 3, 4]])(frames))
    with pytest.raises(InputError, match="detector must be a function"):
        Pipeline(detector=frames)


def test_scores_of_ones_own_detector_count(frames):
    def detect(frame: Frame) -> Detections:
        return Detections(np.array([[40.0, 60, 20, 20], [150, 100, 30, 15]]), np.array([0.9, 0.02]))

    results = list(Pipeline(detector=detect)(frames))
    assert {len(result.tracks) for result in results} == {1}
    with pytest.raises(InputError, match="scores must be probabilities"):
        list(Pipeline(detector=lambda frame: Detections(np.array([[40.0, 60, 20, 20]]), np.array([90.0])))(frames))


@pytest.mark.parametrize("is_seen", [True, False])
def test_boxes_that_move_are_told_and_what_moves_without_a_box_is_kept(frames, is_seen):
    def detect(frame: Frame) -> Detections:
        boxes = np.array([[36.0 + 4 * frame.number, 60, 20, 20], [150, 100, 30, 15]])
        both = Detections(boxes, np.array([0.9, 0.8]), label=np.array(["car", "person"], object))
        return both if is_seen else both[1:]

    settings = with_parameters(Settings(), {"gates.min_area_px": 40})
    results = list(Pipeline(settings, detector=detect, movers=True)(frames))
    assert len(results) == len(frames)
    for result in results[3:-3]:
        found = result.tracked.detections
        speed = dict(zip(found.label.tolist(), found.speed_px.tolist(), strict=True))
        assert len(found) == 2 and speed["person"] == 0 and found.kind == "given"
        assert speed["car" if is_seen else ""] == pytest.approx(4, abs=1.6)  # of a blob without texture
    assert set(results[6].tracks.label.tolist()) == {"person", "car" if is_seen else ""}
    with pytest.raises(InputError, match="movers needs a detector"):
        Pipeline(movers=True)


def test_the_backend_of_a_pipeline_is_that_of_its_tracker_too(frames, monkeypatch):
    pytest.importorskip("torch")
    from torchvision_dddas.tracking import torch_source_tracker

    made: list[object] = []

    class Watched(torch_source_tracker.TorchSourceTracker):
        def __init__(self, *given: Any) -> None:
            made.append(given)
            super().__init__(*given)

    monkeypatch.setattr(torch_source_tracker, "TorchSourceTracker", Watched)
    for backend, count in (("onboard", 0), ("torch", 1)):
        made.clear()
        list(Pipeline("paper", backend=backend)(frames))
        assert len(made) == count


def test_the_pipeline_of_the_front_door_opens_what_the_front_door_opens():
    import torchvision_dddas as td

    front: Any = td.Pipeline
    assert front.open_clip is td.open_video
    with pytest.raises(InputError, match="no_such"):
        next(iter(front("fast")("sim:no_such")))


@pytest.mark.parametrize(("rate_hz", "last_s"), [(4.0, 1.25), (None, 0.5)])
def test_a_folder_of_pictures_has_the_given_rate_or_a_note_and_the_rate_comes_before_a_clock_offset(
    tmp_path, rate_hz, last_s
):
    for number in range(1, 7):
        cv2.imwrite(str(tmp_path / f"{number}.png"), np.zeros((480, 640), np.uint8))
    log = Telemetry(np.array([-9.0, -8.0]), np.full(2, 50.0), np.zeros(2), np.zeros((2, 2)), False)
    pipeline = Pipeline(rate_hz=rate_hz, telemetry=log, camera=CAMERA, detector=lambda _: Detections())
    *_, last = pipeline(tmp_path)
    assert last.frame is not None and last.locations is not None
    assert last.frame.time_s == pytest.approx(last_s)
    assert any("10 frames a second are assumed" in note for note in pipeline.notes) == (rate_hz is None)
    warned = last.locations.fix.cause.split("the telemetry has no data")[0]
    assert ("first give --rate (rate_hz)" in warned) == (rate_hz is None)


def test_frames_are_located_where_telemetry_says_where_the_camera_is(frames):
    camera = Camera("uav", (240, 160), (200.0, 200.0), (119.5, 79.5))
    results = list(Pipeline(None, telemetry=DOWN, camera=camera)(Frame(n, n / 10, f) for n, f in enumerate(frames, 1)))
    assert all(r.locations is not None and r.locations.fix.by == "telemetry" for r in results)


def test_a_pipeline_with_a_ground_platform_has_fused_and_confirmed_targets(frames, tmp_path):
    camera = replace(CAMERA, size_px=(240, 160), centre_px=(119.5, 79.5))
    path = platform(tmp_path, "ugv1", STANDS, "rate_hz = 10")
    pipeline = Pipeline(telemetry=DOWN, camera=camera, ground=path)  # one path is a list of one
    results = list(pipeline(Frame(n, n / 10, f) for n, f in enumerate(frames, 1)))
    assert all(result.confirmed is not None for result in results)
    assert max(len(result.fused) for result in results if result.fused is not None) > 0
    last = results[-1].fused
    assert last is not None and any("ugv1" in seen for seen in last.seen_by)
    assert any("ugv1 locates people" in note for note in pipeline.notes)


def test_a_pipeline_takes_what_the_telemetry_lacks_from_the_camera(frames):
    blind = replace(DOWN, heading_rad=np.full(2, np.nan), pitch_rad=np.full(2, np.nan))
    bare = Camera("uav", (240, 160), (200.0, 200.0), (119.5, 79.5))
    for camera, by in ((bare, ""), (replace(bare, heading_rad=1.0, pitch_rad=1.2), "telemetry")):
        pipeline = Pipeline("fast", telemetry=blind, camera=camera)
        assert {result.locations.fix.by for result in pipeline(frames) if result.locations is not None} == {by}
    assert any("heading_deg, pitch_deg" in note for note in pipeline.notes)


def car_seen_from_above(times_s):
    """Pictures of a car at 5 m/s, 12 px a metre, 50 m below a camera that hovers."""
    rng = np.random.default_rng(0)
    ground = cv2.GaussianBlur(rng.integers(0, 255, (240, 480, 3)).astype(np.uint8), (0, 0), 1.5)
    paint = cv2.resize(rng.integers(0, 2, (6, 11, 3)).astype(np.uint8) * 200 + 30, (44, 24))
    for number, time_s in enumerate(times_s.tolist(), 1):
        image, left = ground.copy(), round(20 + 5 * 12 * time_s)
        image[104:128, left : left + 44] = paint
        yield Frame(number, time_s, image)


class Clip:
    """Frames in memory, whose rate is announced as their mean rate."""

    def __init__(self, frames):
        self.frames, self.size, self.last = list(frames), (480, 240), 0
        self.rate_hz = (len(self.frames) - 1) / self.frames[-1].time_s

    def __iter__(self):
        return iter(self.frames)


GAP = np.arange(60) / 20 + 3.0 * (np.arange(60) >= 30)
VARYING = np.cumsum(np.tile([0.05, 0.05, 0.15, 0.09], 18))


@pytest.mark.parametrize("times_s", [GAP, VARYING - VARYING[0]], ids=["a gap of 3 s", "a varying rate"])
def test_positions_and_speeds_follow_the_time_stamps(times_s):
    camera = Camera("uav", (480, 240), (600.0, 600.0), (239.5, 119.5))
    pipeline = Pipeline("fast", telemetry=DOWN, camera=camera)
    results = list(pipeline(Clip(car_seen_from_above(times_s))))
    located = [result.locations for result in results if result.locations is not None]
    assert [found.time_s for found in located] == pytest.approx(times_s.tolist())
    speeds = np.concatenate([np.linalg.norm(found.velocity_m_s, axis=1) for found in located])
    known = speeds[np.isfinite(speeds)]
    assert len(known) > 20 and np.median(known) == pytest.approx(5.0, abs=0.4)
    way = np.array([found.positions.east_north_m[0] for found in located if len(found.positions)])
    when = np.array([found.time_s for found in located if len(found.positions)])
    assert np.linalg.norm(way[-1] - way[0]) / (when[-1] - when[0]) == pytest.approx(5.0, abs=0.2)


def test_a_repeated_picture_has_the_place_and_speed_of_its_moment_until_it_is_too_old():
    camera = Camera("uav", (480, 240), (600.0, 600.0), (239.5, 119.5))
    flying = replace(DOWN, place=np.array([[0.0, 0.0], [40.0, 0.0]]))
    shown = [*range(20), *[19] * 10, *range(30, 44)]  # the camera is frozen for half a second
    images = [frame.image for frame in car_seen_from_above(np.arange(50) / 20)]
    frames = [Frame(n, (n - 1) / 20, images[k].copy()) for n, k in enumerate(shown, 1)]
    results: list[Any] = [r.locations for r in Pipeline("fast", telemetry=flying, camera=camera)(Clip(frames))]
    last, *frozen = results[19:30]
    assert len(last.positions)
    for n, found in enumerate(frozen, 1):
        assert found.frame == 20 + n and found.time_s == pytest.approx((19 + n) / 20)
        if n <= 5:
            np.testing.assert_allclose(found.positions.east_north_m, last.positions.east_north_m)
            np.testing.assert_allclose(found.velocity_m_s, last.velocity_m_s)
        else:
            assert not len(found.positions) and "frozen" in found.fix.cause


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

    monkeypatch.setattr("torchvision_dddas.pipeline.pipeline.detect_motion", scenes)
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
        (lambda: Pipeline(camera=CAMERA), "need landmarks"),
        (lambda: Pipeline()(LIST[0]), "needs a path or frames, got int"),
        (lambda: Pipeline().update(WRONG), "must be a Frame or a NumPy image, got str"),
        (lambda: list(Pipeline()([np.zeros((8, 8, 3))] * 4)), "must be uint8"),
        (lambda: AerialLocator(CAMERA), "landmarks, or telemetry"),
        (lambda: AerialLocator(CAMERA, WRONG), "expects a Telemetry, got str"),
        (lambda: AerialLocator(CAMERA, DOWN, rate_hz=0), "rate_hz must be positive"),
        (lambda: AerialLocator(CAMERA, DOWN).locate(LIST), "expects Tracks or a TrackedFrame, got list"),
        (lambda: GroundLocator([]), "expects one Camera or several"),
        (lambda: GroundLocator(CAMERA).locate([WRONG]), "expects the People of each camera"),
    ],
)
def test_what_cannot_be_used_is_one_clear_line(make, message):
    with pytest.raises(InputError, match=message):
        make()


def test_telemetry_without_places_locates_nothing_and_says_so(frames):
    pipeline = Pipeline(telemetry=replace(DOWN, place=np.full((2, 2), np.nan)))
    (note,) = pipeline.notes
    assert note.startswith("nothing is located: the telemetry holds no place of the vehicle (add the columns longitude")
    assert note.endswith("), and there are no landmarks")
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


@pytest.mark.parametrize(
    ("altitude_m", "pitch_deg", "reach_m"), [(50.0, 90.0, 500.0), (1500.0, 30.0, 2598.0), (3000.0, 1.0, 10_000.0)]
)
def test_elevations_are_read_as_far_as_the_camera_sees(altitude_m, pitch_deg, reach_m):
    log = Telemetry(
        np.arange(3.0),
        np.full(3, np.nan),
        np.zeros(3),
        above_sea_m=np.full(3, altitude_m),
        pitch_rad=np.radians(np.full(3, pitch_deg)),
    )
    assert view_reach_m(log) == pytest.approx(reach_m, abs=1.0)
    assert view_reach_m(None) == 500.0
