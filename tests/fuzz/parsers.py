"""Everything that reads what others wrote: where its whole files come from, and what is done with them.

A reader may accept a file or refuse it by an InputError of one line. Anything else, a warning too, is a defect.
"""

import random
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import chdir
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from tests.fuzz import seeds
from tests.fuzz.damage import damaged
from tests.fuzz.layouts import LAYOUTS, ROOT
from torchvision_dddas.cli.colours import parse_box, parse_names
from torchvision_dddas.config import PeopleParameters, changes, load_config
from torchvision_dddas.errors import LONGEST, InputError
from torchvision_dddas.evaluation.datasets import kinds
from torchvision_dddas.evaluation.datasets.record import Source
from torchvision_dddas.evaluation.evaluate import evaluate, load_result
from torchvision_dddas.evaluation.metrics import truth
from torchvision_dddas.evaluation.studies.runner import read_spec
from torchvision_dddas.geo.site import looks_swapped
from torchvision_dddas.geometry import poses_at
from torchvision_dddas.io.camera_files import (
    describe_missing,
    has_measurements,
    read_camera,
    read_measurements,
    read_poses,
)
from torchvision_dddas.io.colour_files import read_colours
from torchvision_dddas.io.detection_tables import check_table, read_detections, read_header, read_rows
from torchvision_dddas.io.elevation import read_elevation, read_ortho
from torchvision_dddas.io.ground_tables import read_landmarks, read_positions
from torchvision_dddas.io.images import natural_order
from torchvision_dddas.io.output.run_record import read_run_record
from torchvision_dddas.io.sources import open_source, stream_target, without_secrets
from torchvision_dddas.io.streams import About, open_stream
from torchvision_dddas.io.telemetry import read_telemetry
from torchvision_dddas.live.server import parse_address
from torchvision_dddas.people.classifiers import read_classifier
from torchvision_dddas.people.onnx_scorer import find_graphs
from torchvision_dddas.runtime import MANIFEST, SHIPPED
from torchvision_dddas.simulation import load_scenario, scenario_toml
from torchvision_dddas.types import Camera


@dataclass(frozen=True)
class Parser:
    """A reader under test. file: the name that its input has. read: takes the input's path, and looks at what it gives.

    text: whether damage is done to words and lines, not to bytes alone. words: what means something to the reader.
    beside: other files in the input's folder, whole. needs: a library without which there is no such reader.
    share: how many of the inputs it gets, against the others: what is slow to read gets fewer.
    """

    name: str
    file: str
    seeds: Callable[[], Sequence[bytes]]
    read: Callable[[Path], object]
    text: bool = True
    words: Sequence[str] = ()
    beside: Callable[[], Mapping[str, bytes]] = dict
    needs: str = ""
    share: float = 1.0

    @property
    def there(self) -> bool:
        """Whether what it needs is installed."""
        return not self.needs or find_spec(self.needs) is not None

    def case(self, seed: int, number: int) -> bytes:
        """The input of a number: the same whenever and wherever it is asked for. Number 0 is a whole file."""
        whole = self.seeds()
        if number < len(whole):
            return whole[number]
        return damaged(whole, random.Random(f"{self.name}/{seed}/{number}"), self.text, self.words)

    def prepare(self, folder: Path) -> Path:
        """The folder with what lies beside the input; the input's path in it."""
        path = folder / self.file
        path.parent.mkdir(parents=True, exist_ok=True)
        for name, content in self.beside().items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(content)
        return path

    def try_on(self, path: Path, content: bytes) -> str | None:
        """What the reader says of a content: None where it takes it, the refusal where it does not.

        Raises whatever else the reader raises; AssertionError for a refusal of more than a clear line.
        """
        path.write_bytes(content)
        try:
            self.read(path)
        except InputError as error:
            said = str(error)
            assert said.isprintable(), f"a refusal holds what no terminal shows: {said[:200]!r}"
            assert 0 < len(said) <= LONGEST, f"a refusal of {len(said)} characters: {said[:200]!r}"
            return said
        return None


# -- What is done with each --------------------------------------------------------------------------------------------

_CAMERA = Camera("a", (640, 480), (500.0, 500.0), (319.5, 239.5), (0.0, 0.0), False)
_CORNERS = np.array([[0.0, 0.0], [10.0, 10.0]])
_CLIP = {
    "true/gt.txt": seeds.TEXT["mot"][0].encode(),
    "true/seqinfo.ini": seeds.TEXT["seqinfo"][0].encode(),
    "found/tracks.txt": seeds.TEXT["mot"][0].encode(),
    "found/detections.txt": seeds.TEXT["mot"][1].encode(),
    "found/run.json": seeds.TEXT["record"][0].encode(),
}


def _finite(*arrays: np.ndarray) -> None:
    assert all(np.isfinite(array).all() for array in arrays), "what was read holds numbers that are none"


def _words(path: Path) -> str:
    return path.read_bytes().decode("utf-8", "surrogateescape")


def _detections(path: Path) -> None:
    table = read_detections(path)
    _finite(table.box_px, table.score)
    assert (np.diff(table.frame) >= 0).all()
    _ = (table.extent, table.probable, table.at(table.first))
    read_header(path)
    if len(table):
        read_rows(path)
    _ = table.targets
    check_table(table, 2)


def _truth(path: Path) -> None:
    _ = truth.load_truth(path).frames
    load_result(path)


def _evaluated(path: Path) -> None:
    """The input is the truth, the result or the record of a clip that is scored."""
    evaluate(path.parents[1] / "true", path.parents[1] / "found")


def _clip(without: str) -> Mapping[str, bytes]:
    return {name: content for name, content in _CLIP.items() if name != without}


def _record(path: Path) -> None:
    read_run_record(path.parent)
    load_result(path.parent)


def _positions(path: Path) -> None:
    _finite(read_positions(path).east_north_m)


def _landmarks(path: Path) -> None:
    found = read_landmarks(path, 10.0, 0.5)
    _finite(found.frame)
    looks_swapped(found, (-110.95, 32.23))


def _measurements(path: Path) -> None:
    has_measurements(path)
    _finite(*read_measurements(path))


def _camera(path: Path) -> None:
    describe_missing(path)
    read_camera(path)


def _poses(path: Path) -> None:
    _, poses = poses_at(_CAMERA, read_poses(path), np.array([1, 3, 5]), 10.0)
    _finite(*(np.asarray(values) for values in vars(poses).values()))


def _overrides(path: Path) -> None:
    load_scenario("four", [f"settings.{_words(path)}"])
    load_config(None, [_words(path)])


def _scenario(path: Path) -> None:
    found = load_scenario(path)
    path.write_text(scenario_toml(found), encoding="utf-8")
    assert load_scenario(path) == found, "a scenario that is written is read as another one"


def _telemetry(path: Path) -> None:
    found = read_telemetry(path)
    rising = bool((np.diff(found.time_s) > 0).all()) and bool(np.isfinite(found.time_s).all())
    assert rising, "times that do not rise"
    columns = (found.altitude_m, found.speed_m_s, found.above_sea_m, found.heading_rad, found.pitch_rad, found.place)
    assert not any(np.isinf(column).any() for column in columns), "infinite numbers in a record"
    assert found.at(float(found.time_s[len(found) // 2])) is not None
    assert all(note.isprintable() for note in found.notes), "a note that no terminal shows"
    found.check_overlap(5.0)


def _classifier(path: Path) -> None:
    _finite(read_classifier(path, seeds.FEATURES, PeopleParameters().descriptor).weights)


def _folder(path: Path) -> None:
    for frame in open_source(path.parent):
        assert frame.image.dtype == np.uint8


def _names_of_images(path: Path) -> None:
    sorted((name[:4096] for name in _words(path).splitlines()), key=natural_order)  # no path is longer


def _video(path: Path) -> None:
    numbers = [frame.number for frame in open_source(path).every(2)]
    assert numbers == sorted(set(numbers))


def _input_name(path: Path) -> None:
    """Devices and addresses are not tried."""
    words = _words(path)
    if words.startswith("sim:"):  # without its world, which takes seconds to build
        load_scenario(words[4:])
    elif not re.match(r"camera:\d+$|/dev", words) and "://" not in words:
        open_source(words)


def _address(path: Path) -> None:
    assert 0 <= parse_address(_words(path))[1] <= 65535


def _camera_word(path: Path) -> None:
    without_secrets(_words(path))
    stream_target(_words(path))


def _stream_word(path: Path) -> None:
    """Files alone: an address would be resolved."""
    words = _words(path)
    if "udp" not in words.lower() and not words.endswith("-"):
        with chdir(path.parent):
            open_stream(words, About(0.0), lambda kind, text: None).close()


def _boxes_of_colours(path: Path) -> None:
    parse_names(_words(path))
    parse_box(_words(path))


def _dataset(kind: str, path: Path) -> None:
    """What is wrong with a clip is told, and the clip left out; where none is left that counts as a refusal."""
    folder = next(place for place in path.parents if place.name == ROOT)
    found = kinds.read(Source(kind, folder), folder.parent)
    for line in found.missing:
        assert line.isprintable() and 0 < len(line) <= LONGEST, f"a line that is none: {line[:200]!r}"
    if not found.clips:
        raise InputError(found.missing[0])
    for true in (one.truth for one in found.clips if one.truth is not None):
        for table in (true.tracks, true.ignored, true.others, true.regions):
            _finite(*(table or ()))
        _finite(*([] if true.positions is None else [true.positions.east_north_m]))
        assert true.frames and true.frames[0] >= 1


def _text(kind: str) -> Callable[[], Sequence[bytes]]:
    return partial(seeds.text, kind)


_PLACES = ("east_m", "north_m", "longitude_deg", "latitude_deg", "frame", "time_s", "score", "1", "10000001")
_TOML = (
    "[[", "]]", "[a]", "low", "high", "{}", "[]", "[[]]", "1.0", "inf", "nan", '"x"', "'", "0x7fffffffffffffffff",
    "1e400",
)  # fmt: skip


def _graphs() -> Mapping[str, bytes]:
    return {name: (SHIPPED / name).read_bytes() for name in ("people_histograms.onnx", "people_scores.onnx")}


PARSERS: tuple[Parser, ...] = (
    Parser("MOT text", "gt.txt", _text("mot"), _truth),
    Parser("truth of a clip", "true/gt.txt", _text("mot"), _evaluated, beside=partial(_clip, "true/gt.txt")),
    Parser(
        "tracks of a result", "found/tracks.txt", _text("mot"), _evaluated, beside=partial(_clip, "found/tracks.txt"),
    ),
    Parser(
        "seqinfo.ini", "true/seqinfo.ini", _text("seqinfo"), _evaluated, beside=partial(_clip,
        "true/seqinfo.ini"), share=0.5,
    ),
    Parser(
        "run.json", "found/run.json", _text("record"), _record, words=("Infinity", "NaN", "null", "[]", "{}", '"x"'),
        beside=partial(_clip, "found/run.json"), share=0.5,
    ),
    Parser("detections as text", "detections.txt", _text("mot"), _detections),
    Parser("detections as CSV", "detections.csv", _text("detections"), _detections, words=_PLACES),
    Parser("positions CSV", "positions.csv", _text("positions"), _positions, words=_PLACES),
    Parser("landmarks CSV", "landmarks.csv", _text("landmarks"), _landmarks, words=_PLACES),
    Parser("measurements CSV", "measured.csv", _text("measurements"), _measurements, share=0.5),
    Parser("poses CSV", "poses.csv", _text("poses"), _poses, words=_PLACES),
    Parser("camera TOML", "camera.toml", _text("camera"), _camera, words=_TOML),
    Parser("colours TOML", "colours.toml", _text("colours"), read_colours, words=_TOML),
    Parser("settings TOML", "knobs.toml", _text("settings"), lambda path: changes(load_config(path)), words=_TOML),
    Parser(
        "overrides", "override.txt", _text("overrides"), _overrides, words=("=", ".", "world.side_m=1",
        "crowd.1.people=2"),
    ),
    Parser("scenario TOML", "scenario.toml", _text("scenario"), _scenario, words=_TOML),
    Parser("telemetry CSV", "flight.csv", _text("own telemetry"), _telemetry, words=_PLACES),
    Parser(
        "tables of other programs", "flight.csv", _text("program telemetry"), _telemetry, words=("frame",
        "date", "(rad)"),
    ),
    Parser(
        "SRT", "flight.SRT", _text("subtitles"), _telemetry, words=("-->", "GPS(", "[latitude:", "H 5m",
        "00:00:01,000 --> "),
    ),
    Parser(
        "NMEA 0183", "track.nmea", _text("nmea"), _telemetry, words=("$GPGGA,", "*00", "$", "A", "V", "W"),
        needs="pynmea2",
    ),
    Parser("MISB ST 0601 in MPEG-TS", "video.ts", seeds.misb, _telemetry, text=False),
    Parser("KLV", "flight.klv", seeds.klv, _telemetry, text=False),
    Parser("MAVLink tlog", "flight.tlog", seeds.mavlink, _telemetry, text=False, needs="pymavlink"),
    Parser("PX4 ULog", "flight.ulg", seeds.px4, _telemetry, text=False, needs="pyulog", share=0.7),
    Parser("classifier as text", "a.txt", _text("classifier text"), _classifier, share=0.3),
    Parser("classifier .npy", "a.npy", partial(seeds.classifiers, ".npy"), _classifier, text=False, share=0.3),
    Parser("classifier .npz", "a.npz", partial(seeds.classifiers, ".npz"), _classifier, text=False, share=0.3),
    Parser("classifier .yml", "a.yml", partial(seeds.classifiers, ".yml"), _classifier, share=0.3),
    Parser("classifier .xml", "a.xml", partial(seeds.classifiers, ".xml"), _classifier, share=0.3),
    Parser("classifier .json", "a.json", partial(seeds.classifiers, ".json"), _classifier, share=0.3),
    Parser("manifest of graphs", "manifest.json", lambda: [(SHIPPED / MANIFEST).read_bytes()],
        lambda path: find_graphs(PeopleParameters(graphs=str(path.parent))), beside=_graphs),
    Parser("addresses to serve at", "address.txt", _text("addresses"), _address, share=0.3),
    Parser("names of cameras", "camera.txt", _text("cameras"), _camera_word, words=("camera:", "://", "@"), share=0.3),
    Parser("names of streams", "stream.txt", _text("streams"), _stream_word, words=("json:", "cot:"), share=0.3),
    Parser(
        "folder of PNGs", "clip/frame2.png", partial(seeds.pictures, ".png", True), _folder, text=False,
        beside=lambda: {"clip/frame1.png": seeds.pictures(".png")[0], "clip/frame3.png": seeds.pictures(".png")[1]},
    ),
    Parser(
        "folder of JPEGs", "clip/frame1.jpg", partial(seeds.pictures, ".jpg"), _folder, text=False,
        beside=lambda: {"clip/frame2.jpg": seeds.pictures(".jpg")[0]},
    ),
    Parser("folder of TIFFs", "clip/frame1.tif", partial(seeds.pictures, ".tiff", True), _folder, text=False),
    Parser("folder of other images", "clip/a.ppm", partial(seeds.pictures, ".ppm"), _folder, share=0.5),
    Parser("folder of BMPs", "clip/a.bmp", partial(seeds.pictures, ".bmp"), _folder, text=False, share=0.5),
    Parser("names of images", "names.txt", _text("names of images"), _names_of_images, share=0.5),
    Parser("masks", "000001.png", partial(seeds.pictures, ".png", True), truth.read_mask, text=False, share=0.5),
    Parser("video .avi", "a.avi", partial(seeds.videos, ".avi", "MJPG"), _video, text=False, share=0.15),
    Parser("video .mp4", "a.mp4", partial(seeds.videos, ".mp4", "mp4v"), _video, text=False, share=0.15),
    Parser("video H.264", "a.mp4", seeds.h264, _video, text=False, needs="av", share=0.15),
    Parser("names of inputs", "input.txt", _text("input names"), _input_name, share=0.5),
    Parser("colours by boxes", "box.txt", _text("boxes of colours"), _boxes_of_colours, share=0.3),
    Parser("studies", "study.toml", _text("studies"), read_spec, words=(*_TOML, "[[dataset]]", "kind = ", "folder = ")),
    *(
        Parser(one.name, f"{ROOT}/{one.file}", one.seeds, partial(_dataset, one.kind), words=one.words,
        beside=one.others, share=0.5)
        for one in LAYOUTS
    ),
    Parser("elevation GeoTIFF", "a.tif", partial(seeds.raster, 1),
        lambda path: read_elevation(path, _CORNERS, None, 30.0), text=False, needs="rasterio", share=0.3),
    Parser("photo GeoTIFF", "a.tif", partial(seeds.raster, 3),
        lambda path: read_ortho(path, _CORNERS, None, 30.0), text=False, needs="rasterio", share=0.3),
)  # fmt: skip
