"""Write a simulated run as files for other commands: pictures, telemetry, reports, poses, truth. Film scenarios."""

import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, nullcontext
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import cv2
import numpy as np

from torchvision_dddas import geometry
from torchvision_dddas.config import Settings, format_toml, with_parameters
from torchvision_dddas.errors import InputError
from torchvision_dddas.io.atomic_files import cannot_write, claimed, write_whole
from torchvision_dddas.io.camera_files import DISTORTION
from torchvision_dddas.io.colour_files import format_colours
from torchvision_dddas.io.output import RUN_JSON, OutputPart, PartOf, RunRecord, RunRecorder
from torchvision_dddas.io.overlay_video import OverlayVideo
from torchvision_dddas.io.tables import TextFiles
from torchvision_dddas.lab.simulation.scenario import Scenario, load_scenario, scenario_settings, scenario_toml
from torchvision_dddas.lab.simulation.serving import ServeOptions, SimulatorServer
from torchvision_dddas.lab.simulation.simulator import Shot, Simulator, name_scenario_in_errors, open_simulator
from torchvision_dddas.lab.simulation.truth import TruthOutput, moving_mask
from torchvision_dddas.types import Camera, Flight, GroundPicture

RECORDED = ("frames", "video", "masks", "ground")  # values of --save; the tables are always written
_PLAIN = ("frames", "masks", "ground")  # saved without --save
_TELEMETRY = (
    *("time_s", "altitude_m", "speed_m_s", "longitude_deg", "latitude_deg", "above_sea_m"),
    *("heading_deg", "pitch_deg", "roll_deg", "hfov_deg", "vehicle_heading_deg"),
)
_REPORTS = ("frame", "landmark", "longitude_deg", "latitude_deg", "sigma_m", "planned")
_POSES = ("frame", "longitude_deg", "latitude_deg", "heading_deg", "pitch_deg", "aerial_frame")
_QUALITY = 95


@dataclass(frozen=True)
class _Recorded:
    """A frame of a recording. shown: its picture, or the last picture if the camera dropped the frame.

    ground: the pictures of the ground vehicles. seconds: computing time of the frame, per stage.
    utc_s: when the frame was served, seconds since 1970; NaN if it was not.
    """

    shot: Shot
    shown: np.ndarray
    ground: tuple[GroundPicture, ...]
    seconds: dict[str, float]
    utc_s: float = math.nan


def record_scenario(
    folder: Path,
    scenario: Scenario,
    save: Sequence[str] = _PLAIN,
    frames: int | None = None,
    name: str = "simulated",
    progress: Callable[[str, int], AbstractContextManager[Callable[[], None]]] | None = None,
    serve: ServeOptions | None = None,
) -> RunRecord:
    """Run a scenario, write the data of all its instruments, and return the record of the run.

    save: some of RECORDED. frames: limit of frames. name: the scenario's name in messages. progress: returns a context
    for a name and a number of frames, with a function to call for each frame. serve: the devices as which the world is
    served while it runs; without them nobody steers it. Raises InputError for bad input.
    """
    width, height = scenario.camera.width_px, scenario.camera.height_px
    if "video" in save and (width % 2 or height % 2):
        even = f"camera.width_px={width + width % 2} and camera.height_px={height + height % 2}"
        raise InputError(f"--save video needs an even width and height, got {width}x{height}; set {even}")
    with _RecordingOutput(folder, save) as output, ExitStack() as stack:
        with name_scenario_in_errors(name):
            simulator = open_simulator(scenario)
        server = None if serve is None else stack.enter_context(SimulatorServer(serve, scenario, simulator.names))
        count = min(simulator.frames, frames or simulator.frames)
        record = output.begin(simulator, count, serve)
        shown = nullcontext(lambda: None) if progress is None else progress(Path(name).stem, count)
        with shown as tick:
            for number, frame in enumerate(_run(simulator, count, "ground" in save), 1):
                utc_s = math.nan if server is None else server.show(simulator, frame.shot)
                output.write(replace(frame, utc_s=utc_s))
                tick()
                if number == 1:
                    record.notes += _write_elevation(folder / "dem.tif", simulator)
        if server is not None:
            stack.close()
            record.notes += server.notes
        if "video" in save and record.counts["dropped"]:
            record.notes.append("where the camera dropped a frame, clip.mp4 repeats the last picture")
    return record


def _run(simulator: Simulator, count: int, has_ground: bool) -> Iterator[_Recorded]:
    """Yield the frames of a run. has_ground: whether ground vehicles take pictures."""
    apart = _pictures_apart(simulator.scenario)
    shown = np.zeros((*simulator.camera.size_px[::-1], 3), np.uint8)
    for k in range(count):
        begun = time.perf_counter()
        shot = simulator.next()
        if shot is None:
            return
        seconds = {"air": time.perf_counter() - begun}
        pictures = []
        if has_ground and k % apart == 0:
            begun = time.perf_counter()
            pictures = [simulator.picture(name) for name in simulator.names]
            seconds["ground"] = time.perf_counter() - begun
        shown = shown if shot.frame is None else shot.frame.image
        yield _Recorded(shot, shown, tuple(picture for picture in pictures if picture is not None), seconds)


def _pictures_apart(scenario: Scenario) -> int:
    """Return the number of frames between two pictures of a ground vehicle."""
    apart_s = with_parameters(Settings(), scenario_settings(scenario)).steering.picture_s
    return max(1, round(apart_s * scenario.clip.rate_hz))


def _write_elevation(path: Path, simulator: Simulator) -> list[str]:
    """Write the ground's heights above the sea as a GeoTIFF. Return a note if rasterio is missing."""
    try:
        from rasterio.crs import CRS
        from rasterio.io import MemoryFile
        from rasterio.transform import from_origin
    except ImportError:
        return ["dem.tif is not written because rasterio is missing; pip install 'torchvision-dddas[elevation]'"]
    relief, world = simulator.world.relief, simulator.scenario.world
    heights = (relief.up_m + world.above_sea_m)[::-1].astype(np.float32)
    step = relief.step_m
    top = relief.corner_m[1] + (heights.shape[0] - 0.5) * step
    # Local metres lie on the plane that touches the ellipsoid at the origin, as in `geometry`.
    lon, lat = world.origin_deg
    profile = {
        "driver": "GTiff",
        "height": heights.shape[0],
        "width": heights.shape[1],
        "count": 1,
        "dtype": "float32",
        "crs": CRS.from_proj4(f"+proj=ortho +lat_0={lat!r} +lon_0={lon!r} +datum=WGS84 +units=m"),
        "transform": from_origin(relief.corner_m[0] - step / 2, top, step, step),
        "nodata": np.nan,
    }
    with MemoryFile() as memory:
        with memory.open(**profile) as raster:
            raster.write(heights, 1)
            raster.units = ("m",)
        content = memory.read()
    try:
        write_whole(path, content)
    except OSError as error:
        raise cannot_write(path, error) from error
    return []


class _RecordingOutput(RunRecorder[_Recorded]):
    """The output folder of `dddas simulate`. Raises InputError as RunRecorder does."""

    files: ClassVar[tuple[str, ...]] = (
        *("clip.mp4", "telemetry.csv", "landmarks.csv", "colours.toml", "camera.toml", "dem.tif", "scenario.toml"),
        *("ground/*/camera.toml", "ground/*/platform.toml", "ground/*/poses.csv", *TruthOutput.files, "served.csv"),
        RUN_JSON,
    )
    numbered: ClassVar[tuple[str, ...]] = ("frames", "ground/*", "truth/masks")
    saved: ClassVar[tuple[str, ...]] = RECORDED

    def begin(self, simulator: Simulator, count: int, serve: ServeOptions | None = None) -> RunRecord:
        """Start the record of a run of `count` frames. serve: as in `record_scenario`."""
        scenario, camera, colours = simulator.scenario, simulator.camera, simulator.colours
        rate_hz, folder = scenario.clip.rate_hz, self.folder
        facts = {
            "scenario": scenario.model_dump(mode="json"),
            "clip": {"size": camera.size_px, "rate_hz": rate_hz, "frames": count},
            "outputs": ["tables", *self.save],
        }
        texts = {"camera.toml": _camera_toml(camera), "scenario.toml": scenario_toml(scenario)}
        if len(colours):
            texts["colours.toml"] = format_colours(colours)
        lonlat = partial(geometry.lonlat, origin_deg=scenario.world.origin_deg)
        truth = TruthOutput(folder, lonlat, "masks" in self.save)
        parts: dict[str, OutputPart[_Recorded]] = {
            "tables": _Tables(folder, simulator.names, texts),
            "truth": PartOf(truth, lambda item: item.shot.truth),
            "frames": _Frames(folder / "frames"),
            "video": OverlayVideo(folder, rate_hz, lambda item: item.shown, "clip.mp4"),
            "ground": _Ground(folder / "ground", simulator.names, rate_hz / _pictures_apart(scenario)),
        }
        if serve is not None:
            facts["served"] = asdict(serve)
            parts["served"] = _Served(folder)
        record = self.start(facts, parts)
        record.counts = {"events": [], "dropped": 0}
        return record

    def _count(self, item: _Recorded) -> None:
        truth, counts, is_dropped = item.shot.truth, self.record.counts, item.shot.frame is None
        counts["events"] += [{"frame": truth.frame, "time_s": truth.time_s, "what": what} for what in truth.events]
        counts["dropped"] += is_dropped
        targets = len(np.unique(truth.bodies.target[truth.bodies.kind != "ugv"]))
        self.record.note(truth.frame, targets, item.seconds, cause="dropped" if is_dropped else None)


class _Tables:
    """Writes telemetry.csv and landmarks.csv, and with the first frame the files of fixed text.

    Plans are written at the end, because only a vehicle's newest plan for a frame counts.
    """

    def __init__(self, folder: Path, names: Sequence[str], texts: dict[str, str]) -> None:
        content = {"telemetry.csv": _TELEMETRY, "landmarks.csv": _REPORTS}
        self._files = TextFiles({folder / name: ",".join(columns) + "\n" for name, columns in content.items()})
        self._folder, self._names, self._texts = folder, names, texts
        self._plans: dict[tuple[int, float], str] = {}
        self.discard = self._files.discard

    def write(self, item: _Recorded) -> None:
        while self._texts:
            name, text = self._texts.popitem()
            write_whole(self._folder / name, text.encode())
        flights, reports = [], []
        for moment in item.shot.moments:
            if moment.flight is not None:
                flights.append(_flight_line(moment.time_s, moment.flight))
            for r in moment.reports:
                name, (lon, lat) = self._names[r.vehicle], r.lonlat_deg
                line = f"{_short(r.frame, 6)},{name},{lon:.9f},{lat:.9f},{r.sigma_m:.6g},{r.planned:d}\n"
                if r.planned:
                    self._plans[r.vehicle, round(r.frame, 6)] = line
                else:
                    reports.append(line)
        self._files.write("".join(flights), "".join(reports))

    def close(self, complete: bool) -> None:
        self._files.write("", "".join(self._plans.values()))
        self._files.close()


class _Served:
    """Writes served.csv: when each frame of a served world was sent, by this machine's clock."""

    def __init__(self, folder: Path) -> None:
        self._files = TextFiles({folder / "served.csv": "frame,time_s,utc_s\n"})
        self.discard = self._files.discard

    def write(self, item: _Recorded) -> None:
        truth = item.shot.truth
        self._files.write(f"{truth.frame},{_short(truth.time_s, 6)},{item.utc_s:.6f}\n")

    def close(self, complete: bool) -> None:
        self._files.close()


class _Frames(OutputPart[_Recorded]):
    """Writes frames/000001.jpg and so on. A dropped frame is an empty file, so that the others keep their numbers."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def write(self, item: _Recorded) -> None:
        self._folder.mkdir(parents=True, exist_ok=True)
        number, frame = item.shot.truth.frame, item.shot.frame
        write_whole(self._folder / f"{number:06d}.jpg", b"" if frame is None else _encode_jpeg(frame.image))


class _Ground:
    """Writes ground/ugv1/000001.jpg and so on, with poses.csv, camera.toml and platform.toml beside them."""

    def __init__(self, folder: Path, names: Sequence[str], rate_hz: float) -> None:
        self._rate_hz = rate_hz
        self._folder, self._count = folder, dict.fromkeys(names, 0)
        self._poses: dict[str, TextFiles] = {}

    def write(self, item: _Recorded) -> None:
        for picture in item.ground:
            name, camera, folder = picture.vehicle, picture.camera, self._folder / picture.vehicle
            if name not in self._poses:
                folder.mkdir(parents=True, exist_ok=True)
                write_whole(folder / "camera.toml", _camera_toml(camera, is_standing=True).encode())
                keys = {"name": name, "clip": ".", "camera": "camera.toml", "poses": "poses.csv"}
                write_whole(folder / "platform.toml", format_toml(keys | {"rate_hz": self._rate_hz}).encode())
                self._poses[name] = TextFiles({folder / "poses.csv": ",".join(_POSES) + "\n"})
            number = self._count[name] = self._count[name] + 1
            write_whole(folder / f"{number:06d}.jpg", _encode_jpeg(picture.image))
            angles = f"{math.degrees(camera.heading_rad) % 360:.4f},{math.degrees(camera.pitch_rad):.4f}"
            place = f"{camera.place[0]:.9f},{camera.place[1]:.9f}"
            self._poses[name].write(f"{number},{place},{angles},{picture.frame}\n")

    def close(self, complete: bool) -> None:
        for poses in self._poses.values():
            poses.close()

    def discard(self) -> None:
        for poses in self._poses.values():
            poses.discard()


def film(
    scenario: Scenario, seed: int | None = None, frames: int | None = None, size_px: tuple[int, int] | None = None
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield images (H, W, 3) uint8 BGR and masks (H, W) uint16 of a scenario. Masks number the moving targets.

    seed, frames, size_px (width, height): replace the scenario's own values. Dropped frames are left out.
    """
    changed: dict[str, Any] = {} if seed is None else {"seed": seed}
    if size_px is not None:
        size = dict(zip(("width_px", "height_px"), size_px, strict=True))
        changed["camera"] = scenario.camera.model_copy(update=size)
    simulator = open_simulator(scenario.model_copy(update=changed))
    for _ in range(simulator.frames if frames is None else min(frames, simulator.frames)):
        shot = simulator.next()
        if shot is not None and shot.frame is not None:
            yield shot.frame.image, moving_mask(shot.truth)


def film_clip(
    folder: Path,
    seed: int | None = None,
    frames: int | None = None,
    size_px: tuple[int, int] | None = None,
    scenario: str = "demo",
    tick: Callable[[], object] = lambda: None,
) -> Path:
    """Film a scenario into frames/000001.jpg ... and masks/000001.png ... of a folder. Return the folder.

    The other arguments are those of `film`. tick is called after each frame. Raises InputError for an unknown scenario
    or if the files cannot be written.
    """
    try:
        with claimed(folder):
            for part in ("frames", "masks"):
                (folder / part).mkdir(parents=True, exist_ok=True)
            for number, (image, mask) in enumerate(film(load_scenario(scenario), seed, frames, size_px), 1):
                png = cv2.imencode(".png", mask.astype(np.uint8))[1]
                write_whole(folder / "frames" / f"{number:06d}.jpg", _encode_jpeg(image))
                write_whole(folder / "masks" / f"{number:06d}.png", png.tobytes())
                tick()
    except OSError as error:
        raise cannot_write(Path(error.filename or folder), error) from error
    return folder


def _encode_jpeg(image: np.ndarray) -> bytes:
    """Encode a picture as a JPEG of high quality. Raises OSError if encoding fails."""
    ok, content = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    if not ok:
        raise OSError("a picture could not be encoded")
    return content.tobytes()


def _camera_toml(camera: Camera, is_standing: bool = False) -> str:
    """Return the text of a camera file. is_standing: add a ground camera's height, angles and uncertainties."""
    keys: dict[str, object] = {
        "name": camera.name,
        "width_px": camera.size_px[0],
        "height_px": camera.size_px[1],
        "focal_px": float(camera.focal_px[0]),
        "focal_v_px": float(camera.focal_px[1]),
        "centre_px": [float(value) for value in camera.centre_px],
        **dict(zip(DISTORTION, camera.distortion, strict=True)),
    }
    if is_standing:
        keys |= {
            "height_m": camera.height_m,
            "pitch_deg": _rounded(math.degrees(camera.pitch_rad)),
            "roll_deg": _rounded(math.degrees(camera.roll_rad)),
            "focal_sigma": camera.focal_sigma,
            "height_sigma_m": camera.height_sigma_m,
            "pitch_sigma_deg": _rounded(math.degrees(camera.pitch_sigma_rad)),
            "heading_sigma_deg": _rounded(math.degrees(camera.heading_sigma_rad)),
            "position_sigma_m": _rounded(camera.position_sigma_m),
        }
    return format_toml(keys)


def _rounded(value: float) -> float:
    return float(f"{value:.6g}")


def _flight_line(time_s: float, flight: Flight) -> str:
    """Return a line of telemetry.csv. Cells of unknown values are empty."""
    angles = (flight.heading_rad, flight.pitch_rad, flight.roll_rad, flight.hfov_rad, flight.vehicle_heading_rad)
    cells = [_short(time_s, 6), _short(flight.altitude_m, 4), _short(flight.speed_m_s, 4)]
    cells += [_short(v, 9) for v in flight.place] + [_short(flight.above_sea_m, 4)]
    return ",".join(cells + [_short(math.degrees(v), 5) for v in angles]) + "\n"


def _short(value: float, digits: int) -> str:
    return f"{value:.{digits}f}".rstrip("0").rstrip(".") if math.isfinite(value) else ""
