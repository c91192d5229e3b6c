"""What the instruments of a simulated run give, as files that the tools take: pictures, telemetry, reports, poses."""

import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import cv2
import numpy as np

from torchvision_dddas import geometry
from torchvision_dddas.config import Settings, format_toml, with_parameters
from torchvision_dddas.io.atomic_files import cannot_write, remove, temporary, write_whole
from torchvision_dddas.io.colour_files import format_colours
from torchvision_dddas.io.output import RUN_JSON, Part, RunRecord, RunRecorder
from torchvision_dddas.io.overlay_video import OverlayVideo
from torchvision_dddas.io.tables import TextFiles
from torchvision_dddas.simulation.scenario import Scenario
from torchvision_dddas.simulation.scenario_file import load_scenario, scenario_settings, scenario_toml
from torchvision_dddas.simulation.simulator import Simulator
from torchvision_dddas.simulation.source import name_scenario_in_errors, open_simulator
from torchvision_dddas.simulation.truth import LonLat, TruthOutput, moving_mask
from torchvision_dddas.types import Camera, Colours, Flight, GroundPicture, Truth

RECORDED = ("frames", "video", "masks", "ground")  # what --save may name. The tables are always written

PLAIN = ("frames", "masks", "ground")  # what is saved where --save is not given

TELEMETRY = (
    *("time_s", "altitude_m", "speed_m_s", "longitude_deg", "latitude_deg", "above_sea_m"),
    *("heading_deg", "pitch_deg", "roll_deg", "hfov_deg", "vehicle_heading_deg"),
)
REPORTS = ("frame", "landmark", "longitude_deg", "latitude_deg", "sigma_m", "planned")
POSES = ("frame", "longitude_deg", "latitude_deg", "heading_deg", "pitch_deg", "aerial_frame")
QUALITY = 95


@dataclass(frozen=True)
class RadioReport:
    """A report of a ground vehicle: its name, frame (may be broken), longitude and latitude, standard deviation."""

    vehicle: str
    frame: float
    lonlat_deg: np.ndarray
    sigma_m: float
    planned: bool = False


@dataclass(frozen=True)
class RecordedFrame:
    """All that a frame of a simulated run gives. image: None where the camera dropped it.

    flights: what the UAV reported since the frame before, and when. heard: what the ground vehicles did.
    ground: what they saw. seconds: spent on it, per stage.
    """

    truth: Truth
    image: np.ndarray | None
    flights: tuple[tuple[float, Flight], ...] = ()
    heard: tuple[RadioReport, ...] = ()
    ground: tuple[GroundPicture, ...] = ()
    seconds: dict[str, float] = field(default_factory=dict)


def record_scenario(
    folder: Path,
    scenario: Scenario,
    save: Sequence[str] = PLAIN,
    frames: int | None = None,
    name: str = "simulated",
    progress: Callable[[str, int], AbstractContextManager[Callable[[], None]]] | None = None,
) -> RunRecord:
    """Run a scenario that nobody steers and write all that its instruments give; returns the record of the run.

    save: some of RECORDED. frames: how many at most. name: the scenario's, for messages. progress: given a name and the
    number of frames, a context with a function that is called for each frame. Raises InputError for bad input.
    """
    with RecordingOutput(folder, save) as output:
        with name_scenario_in_errors(name):
            simulator = open_simulator(scenario)
        count = min(simulator.frames, frames or simulator.frames)
        facts = {
            "scenario": scenario.model_dump(mode="json"),
            "clip": {"size": simulator.camera.size_px, "rate_hz": scenario.clip.rate_hz, "frames": count},
        }
        origin = scenario.world.origin_deg
        record = output.begin(
            facts,
            scenario.clip.rate_hz,
            simulator.camera,
            simulator.colours,
            scenario_toml(scenario),
            lambda metres: geometry.lonlat(metres, origin),
        )
        shown = nullcontext(lambda: None) if progress is None else progress(Path(name).stem, count)
        with shown as tick:
            for number, frame in enumerate(_film_all(simulator, "ground" in save), 1):
                output.write(frame)
                tick()
                if number == 1:
                    record.notes += _write_elevation(folder / "dem.tif", simulator)
                if number == count:
                    break
        if "video" in save and record.counts["dropped"]:
            record.notes.append("where the camera dropped a frame, clip.mp4 shows the one before again")
    return record


def _film_all(simulator: Simulator, has_ground: bool) -> Iterator[RecordedFrame]:
    """The frames of a run that nobody steers. has_ground: whether ground vehicles take pictures, all at once."""
    scenario = simulator.scenario
    apart_s = with_parameters(Settings(), scenario_settings(scenario)).steering.picture_s
    apart = max(1, round(apart_s * scenario.clip.rate_hz))
    while True:
        begun = time.perf_counter()
        shot = simulator.next()
        if shot is None:
            return
        drawn = time.perf_counter()
        is_due = has_ground and (shot.truth.frame - 1) % apart == 0
        pictures = [simulator.picture(name) for name in simulator.names] if is_due else []
        yield RecordedFrame(
            shot.truth,
            None if shot.frame is None else shot.frame.image,
            tuple((moment.time_s, moment.flight) for moment in shot.said if moment.flight is not None),
            tuple(
                RadioReport(simulator.names[r.vehicle], r.frame, r.lonlat_deg, r.sigma_m, r.planned)
                for moment in shot.said
                for r in moment.reports
            ),
            tuple(picture for picture in pictures if picture is not None),
            {"air": drawn - begun} | ({"ground": time.perf_counter() - drawn} if is_due else {}),
        )


def _write_elevation(path: Path, simulator: Simulator) -> list[str]:
    """Write the ground's heights above the sea as a GeoTIFF; returns a note if rasterio is missing."""
    try:
        import rasterio
        from rasterio.crs import CRS
        from rasterio.transform import from_origin
    except ImportError:
        return ["dem.tif is left out: it needs rasterio, pip install 'torchvision-dddas[elevation]'"]
    relief, world = simulator.world.relief, simulator.scenario.world
    heights = (relief.up_m + world.above_sea_m)[::-1].astype(np.float32)
    # The plane that touches the ellipsoid at the origin, as in `geometry`.
    lon, lat = world.origin_deg
    local = CRS.from_proj4(f"+proj=ortho +lat_0={lat!r} +lon_0={lon!r} +datum=WGS84 +units=m")
    step = relief.step_m
    top = relief.corner_m[1] + (heights.shape[0] - 0.5) * step
    part = temporary(path)
    try:
        with rasterio.open(
            part,
            "w",
            driver="GTiff",
            height=heights.shape[0],
            width=heights.shape[1],
            count=1,
            dtype="float32",
            crs=local,
            transform=from_origin(relief.corner_m[0] - step / 2, top, step, step),
            nodata=np.nan,
        ) as raster:
            raster.write(heights, 1)
            raster.units = ("m",)
        part.replace(path)
    except OSError as error:
        remove(part)
        raise cannot_write(path, error) from error
    return []


class RecordingOutput(RunRecorder[RecordedFrame]):
    """Everything that `dddas simulate` writes. Raises InputError as RunRecorder does."""

    files: ClassVar[tuple[str, ...]] = (
        *("frames/000001.jpg", "clip.mp4", "telemetry.csv", "landmarks.csv", "colours.toml", "camera.toml", "dem.tif"),
        *("scenario.toml", *TruthOutput.files, RUN_JSON),
    )

    def begin(
        self,
        facts: dict[str, Any],
        rate_hz: float,
        camera: Camera,
        colours: Colours,
        scenario: str,
        lonlat: LonLat,
    ) -> RunRecord:
        """Say what the run is, for run.json.

        scenario: the text of scenario.toml. lonlat: (N, 2) longitudes and latitudes of (N, 2) local metres.
        """
        texts = {"camera.toml": camera_toml(camera), "scenario.toml": scenario}
        if len(colours):
            texts["colours.toml"] = format_colours(colours)
        parts: dict[str, Part[RecordedFrame]] = {
            "texts": _Texts(self.folder, texts),
            "reports": _Reports(self.folder),
            "truth": _Truth(self, lonlat),
        }
        if "frames" in self.save:
            parts["frames"] = _Frames(self.folder / "frames")
        if "video" in self.save:
            parts["video"] = _Video(self.folder, rate_hz, camera.size_px)
        if "ground" in self.save:
            parts["ground"] = _Ground(self.folder / "ground", colours.names)
        record = self.start({**facts, "outputs": ["tables", *self.save]}, parts)
        record.counts = {"events": [], "dropped": 0}
        return record

    def _count(self, item: RecordedFrame) -> None:
        truth, counts = item.truth, self.record.counts
        counts["events"] += [{"frame": truth.frame, "time_s": truth.time_s, "what": what} for what in truth.events]
        counts["dropped"] += item.image is None
        targets = len(np.unique(truth.bodies.target[truth.bodies.kind != "ugv"]))
        self.record.note(truth.frame, targets, item.seconds, cause="dropped" if item.image is None else None)

    @property
    def masks(self) -> bool:
        """Whether masks are to be written."""
        return "masks" in self.save


class _Texts:
    """Files that are known from the start, written with the first frame."""

    def __init__(self, folder: Path, texts: dict[str, str]) -> None:
        self._folder, self._texts = folder, texts
        self._begun = False

    def write(self, item: RecordedFrame) -> None:
        if not self._begun:
            for name, text in self._texts.items():
                write_whole(self._folder / name, text.encode())
        self._begun = True

    def close(self, complete: bool) -> None:
        pass

    def discard(self) -> None:
        pass


class _Reports:
    """telemetry.csv and landmarks.csv. Of what a vehicle plans for a frame the newest counts: plans come at the end."""

    def __init__(self, folder: Path) -> None:
        content = {"telemetry.csv": TELEMETRY, "landmarks.csv": REPORTS}
        self._files = TextFiles({folder / name: ",".join(columns) + "\n" for name, columns in content.items()})
        self._plans: dict[tuple[str, float], str] = {}

    def write(self, item: RecordedFrame) -> None:
        flights = [_flight_line(time_s, flight) for time_s, flight in item.flights]
        self._plans |= {(h.vehicle, round(h.frame, 6)): _report_line(h) for h in item.heard if h.planned}
        heard = [_report_line(h) for h in item.heard if not h.planned]
        self._files.write("".join(flights), "".join(heard))

    def close(self, complete: bool) -> None:
        self._files.write("", "".join(self._plans.values()))
        self._files.close()

    def discard(self) -> None:
        self._files.discard()


class _Truth:
    """truth/, of the frames that are there or were dropped."""

    def __init__(self, output: RecordingOutput, lonlat: LonLat) -> None:
        self._sink = TruthOutput(output.folder, lonlat, output.masks)
        self.close, self.discard = self._sink.close, self._sink.discard

    def write(self, item: RecordedFrame) -> None:
        self._sink.write(item.truth)


class _Frames:
    """frames/000001.jpg and so on; a dropped frame is a file without content, so that the others keep their numbers."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._last = 0

    def write(self, item: RecordedFrame) -> None:
        self._folder.mkdir(parents=True, exist_ok=True)
        self._last = item.truth.frame
        write_whole(self._folder / f"{self._last:06d}.jpg", b"" if item.image is None else encode_jpeg(item.image))

    def close(self, complete: bool) -> None:
        clear_after(self._folder, self._last)

    def discard(self) -> None:
        pass


class _Video(OverlayVideo[np.ndarray]):
    """clip.mp4, H.264 where PyAV is installed; in place of a dropped frame the one before is there again."""

    def __init__(self, folder: Path, rate_hz: float, size: tuple[int, int]) -> None:
        super().__init__(folder, rate_hz, lambda image: image, "clip.mp4")
        self._before = np.zeros((*size[::-1], 3), np.uint8)

    def write(self, item: Any) -> None:
        if item.image is not None:
            self._before = item.image
        super().write(self._before)


class _Ground:
    """ground/ugv1/000001.jpg and so on, poses.csv and camera.toml beside them."""

    def __init__(self, folder: Path, names: Sequence[str]) -> None:
        self._folders = {name: folder / name for name in names}
        self._count = dict.fromkeys(names, 0)
        self._poses: dict[str, TextFiles] = {}

    def write(self, item: RecordedFrame) -> None:
        for picture in item.ground:
            name, camera = picture.vehicle, picture.camera
            folder = self._folders[name]
            if not self._count[name]:
                folder.mkdir(parents=True, exist_ok=True)
                write_whole(folder / "camera.toml", camera_toml(camera, standing=True).encode())
                self._poses[name] = TextFiles({folder / "poses.csv": ",".join(POSES) + "\n"})
            number = self._count[name] = self._count[name] + 1
            write_whole(folder / f"{number:06d}.jpg", encode_jpeg(picture.image))
            angles = f"{math.degrees(camera.heading_rad) % 360:.4f},{math.degrees(camera.pitch_rad):.4f}"
            place = f"{camera.place[0]:.9f},{camera.place[1]:.9f}"
            self._poses[name].write(f"{number},{place},{angles},{picture.frame}\n")

    def close(self, complete: bool) -> None:
        for name, folder in self._folders.items():
            clear_after(folder, self._count[name])
            if name in self._poses:
                self._poses[name].close()
            else:
                remove(folder / "poses.csv")

    def discard(self) -> None:
        for poses in self._poses.values():
            poses.discard()


def film(
    scenario: Scenario, seed: int | None = None, frames: int | None = None, size_px: tuple[int, int] | None = None
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """The images (H, W, 3) uint8 BGR and masks (H, W) uint16 of a scenario; a mask numbers the targets that move.

    seed, frames, size_px (width, height): in place of the scenario's own. A dropped frame is left out.
    """
    changed: dict[str, Any] = {}
    if seed is not None:
        changed["seed"] = seed
    if size_px is not None:
        width, height = size_px
        changed["camera"] = scenario.camera.model_copy(update={"width_px": width, "height_px": height})
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
    """Film a scenario into frames/000001.jpg ... and masks/000001.png ... of a folder, which is returned.

    The rest as in `film`; tick is called after each frame. Raises InputError if there is no such scenario or the disk
    refuses.
    """
    try:
        for part in ("frames", "masks"):
            (folder / part).mkdir(parents=True, exist_ok=True)
        for number, (image, mask) in enumerate(film(load_scenario(scenario), seed, frames, size_px), 1):
            png = cv2.imencode(".png", mask.astype(np.uint8))[1]
            write_whole(folder / "frames" / f"{number:06d}.jpg", encode_jpeg(image))
            write_whole(folder / "masks" / f"{number:06d}.png", png.tobytes())
            tick()
    except OSError as error:
        raise cannot_write(Path(error.filename or folder), error) from error
    return folder


def encode_jpeg(image: np.ndarray) -> bytes:
    """A picture as a JPEG that adds next to nothing to it. Raises OSError where it cannot be encoded."""
    ok, content = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    if not ok:
        raise OSError("a picture could not be encoded")
    return content.tobytes()


def clear_after(folder: Path, last: int) -> None:
    """Remove the pictures of an earlier, longer run, so that the folder speaks of one run only."""
    for path in folder.glob("*.jpg"):
        if path.stem.isdecimal() and int(path.stem) > last:
            with suppress(OSError):
                path.unlink()


def camera_toml(camera: Camera, standing: bool = False) -> str:
    """A camera's file. standing: with height, pitch, roll and how well it knows its place, as one on the ground has."""
    keys: dict[str, object] = {
        "name": camera.name,
        "width_px": camera.size_px[0],
        "height_px": camera.size_px[1],
        "focal_px": float(camera.focal_px[0]),
        "focal_v_px": float(camera.focal_px[1]),
        "centre_px": [float(value) for value in camera.centre_px],
        "k1": camera.k1,
        "k2": camera.k2,
    }
    if standing:
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


def _report_line(heard: RadioReport) -> str:
    """A line of landmarks.csv."""
    lon, lat = heard.lonlat_deg
    return f"{_short(heard.frame, 6)},{heard.vehicle},{lon:.9f},{lat:.9f},{heard.sigma_m:.6g},{heard.planned:d}\n"


def _flight_line(time_s: float, flight: Flight) -> str:
    """A line of telemetry.csv; a cell is empty where the UAV does not say."""
    angles = (flight.heading_rad, flight.pitch_rad, flight.roll_rad, flight.hfov_rad, flight.vehicle_heading_rad)
    cells = [_short(time_s, 6), _short(flight.altitude_m, 4), _short(flight.speed_m_s, 4)]
    cells += [_short(v, 9) for v in flight.place] + [_short(flight.above_sea_m, 4)]
    return ",".join(cells + [_short(math.degrees(v), 5) for v in angles]) + "\n"


def _short(value: float, digits: int) -> str:
    return f"{value:.{digits}f}".rstrip("0").rstrip(".") if math.isfinite(value) else ""
