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
from torchvision_dddas.cli.colours import parse_box, parse_names
from torchvision_dddas.config import PeopleParameters, changes, load_config
from torchvision_dddas.errors import LONGEST, InputError, without_secrets
from torchvision_dddas.geo.site import looks_swapped
from torchvision_dddas.geometry import poses_at
from torchvision_dddas.io import camera_files
from torchvision_dddas.io.colour_files import read_colours
from torchvision_dddas.io.detection_tables import check_table, read_detections, read_header, read_rows
from torchvision_dddas.io.elevation import read_elevation, read_ortho
from torchvision_dddas.io.ground_tables import read_landmarks, read_positions
from torchvision_dddas.io.images import natural_order
from torchvision_dddas.io.output.run_record import read_run_record
from torchvision_dddas.io.sources import open_source, stream_target
from torchvision_dddas.io.streams import About, open_stream
from torchvision_dddas.io.telemetry import read_telemetry
from torchvision_dddas.lab.evaluation.datasets import kinds
from torchvision_dddas.lab.evaluation.datasets.record import DatasetSource
from torchvision_dddas.lab.evaluation.evaluate import evaluate, load_result
from torchvision_dddas.lab.evaluation.metrics import truth
from torchvision_dddas.lab.evaluation.studies.runner import read_spec
from torchvision_dddas.lab.simulation import load_scenario, scenario_toml
from torchvision_dddas.live.server import parse_address
from torchvision_dddas.people.classifiers import read_classifier
from torchvision_dddas.people.onnx_scorer import find_graphs
from torchvision_dddas.runtime import MANIFEST, SHIPPED
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
    words: Sequence[str] = ()
    share: float = 1.0
    text: bool = True
    beside: Callable[[], Mapping[str, bytes]] = dict
    needs: str = ""

    @property
    def there(self) -> bool:
        """Whether what it needs is installed."""
        return not self.needs or find_spec(self.needs) is not None

    def case(self, seed: int, number: int) -> bytes:
        """The input of a number: the same whenever and wherever it is asked for. The first are the whole files."""
        whole = self.seeds()
        if number < len(whole):
            return whole[number]
        return damaged(whole, random.Random(f"{self.name}/{seed}/{number}"), self.text, self.words)

    def prepare(self, folder: Path) -> Path:
        """The folder with what lies beside the input; the input's path in it."""
        for name, content in {self.file: b"", **self.beside()}.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            if name != self.file:
                (folder / name).write_bytes(content)
        return folder / self.file

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
ROOT = "set"
"""The folder of a data set."""
_CLIP = {
    "true/gt.txt": seeds.TEXT["mot"][0].encode(),
    "true/seqinfo.ini": seeds.TEXT["seqinfo"][0].encode(),
    "found/tracks.txt": seeds.TEXT["mot"][0].encode(),
    "found/detections.txt": seeds.TEXT["mot"][1].encode(),
    "found/run.json": seeds.TEXT["record"][0].encode(),
}


def _check_finite(*arrays: np.ndarray) -> None:
    assert all(np.isfinite(array).all() for array in arrays), "what was read holds numbers that are none"


def _words(path: Path) -> str:
    return path.read_bytes().decode("utf-8", "surrogateescape")


def _detections(path: Path) -> None:
    table = read_detections(path)
    _check_finite(table.box_px, table.score)
    assert (np.diff(table.frame) >= 0).all()
    _ = (table.extent, table.probable, table.at(table.first), table.targets)
    read_header(path)
    if len(table):
        read_rows(path)
    check_table(table, 2)


def _evaluated(path: Path) -> None:
    """The input is the truth, the result or the record of a clip that is scored."""
    evaluate(path.parents[1] / "true", path.parents[1] / "found")


def _landmarks(path: Path) -> None:
    found = read_landmarks(path, rate_hz=10.0, clock_offset_s=0.5)
    _check_finite(found.frame)
    looks_swapped(found, (-110.95, 32.23))


def _measurements(path: Path) -> None:
    camera_files.has_measurements(path)
    _check_finite(*camera_files.read_measurements(path))


def _poses(path: Path) -> None:
    _, poses = poses_at(_CAMERA, camera_files.read_poses(path), np.array([1, 3, 5]), 10.0)
    _check_finite(*(np.asarray(values) for values in vars(poses).values()))


def _overrides(path: Path) -> None:
    load_scenario("four", [f"settings.{_words(path)}"])
    load_config(None, [_words(path)])


def _scenario(path: Path) -> None:
    found = load_scenario(path)
    path.write_text(scenario_toml(found), encoding="utf-8")
    assert load_scenario(path) == found, "a scenario that is written is read as another one"


def _telemetry(path: Path) -> None:
    found = read_telemetry(path)
    assert (np.diff(found.time_s) > 0).all() and np.isfinite(found.time_s).all(), "times that do not rise"
    columns = (found.altitude_m, found.speed_m_s, found.above_sea_m, found.heading_rad, found.pitch_rad, found.place)
    assert not any(np.isinf(column).any() for column in columns), "infinite numbers in a record"
    assert found.at(float(found.time_s[len(found) // 2])) is not None
    assert all(note.isprintable() for note in found.notes), "a note that no terminal shows"
    found.check_overlap(5.0)


def _classifier(path: Path) -> None:
    _check_finite(read_classifier(path, seeds.FEATURES, PeopleParameters().descriptor).weights)


def _folder(path: Path) -> None:
    assert all(frame.image.dtype == np.uint8 for frame in open_source(path.parent))


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


def _other_words(path: Path) -> None:
    """Names of images, cameras and colours."""
    words = _words(path)
    sorted((name[:4096] for name in words.splitlines()), key=natural_order)  # no path is longer
    without_secrets(words)
    stream_target(words)
    parse_names(words)
    parse_box(words)


def _address(path: Path) -> None:
    assert 0 <= parse_address(_words(path))[1] <= 65535


def _stream_word(path: Path) -> None:
    """Files alone: an address would be resolved."""
    words = _words(path)
    if "udp" not in words.lower() and not words.endswith("-"):
        with chdir(path.parent):
            open_stream(words, About(0.0), lambda kind, text: None).close()


def _dataset(kind: str, path: Path) -> None:
    """What is wrong with a clip is said, and the clip left out; where none is left that counts as a refusal."""
    folder = next(place for place in path.parents if place.name == ROOT)
    found = kinds.read(DatasetSource(kind, folder), folder.parent)
    for line in found.missing:
        assert line.isprintable() and 0 < len(line) <= LONGEST, f"a line that is none: {line[:200]!r}"
    if not found.clips:
        raise InputError(found.missing[0])
    for true in (one.truth for one in found.clips if one.truth is not None):
        for table in (true.tracks, true.ignored, true.others, true.regions):
            _check_finite(*(table or ()))
        _check_finite(*([] if true.positions is None else [true.positions.east_north_m]))
        assert true.frames and true.frames[0] >= 1


# -- The readers -------------------------------------------------------------------------------------------------------

_PLACES = ("east_m", "north_m", "longitude_deg", "latitude_deg", "frame", "time_s", "score", "1", "10000001")
_JSON = ("Infinity", "NaN", "null", "[]", "{}", '"x"')
_TOML = ("[[", "]]", "[a]", "low", "{}", "[]", "[[]]", "1.0", "inf", "nan", '"x"', "'", "1e400", "0x7fffffffffffffffff")
# Name, file, what is done, seeds, words, share.
_TEXTS: tuple[tuple[str, str, Callable[[Path], object], str, Sequence[str], float], ...] = (
    ("MOT text", "gt.txt", lambda path: (truth.load_truth(path).frames, load_result(path)), "mot", (), 1),
    ("truth of a clip", "true/gt.txt", _evaluated, "mot", (), 1),
    ("tracks of a result", "found/tracks.txt", _evaluated, "mot", (), 1),
    ("seqinfo.ini", "true/seqinfo.ini", _evaluated, "seqinfo", (), 0.5),
    ("run.json", "found/run.json", lambda p: (read_run_record(p.parent), load_result(p.parent)), "record", _JSON, 0.5),
    ("detections as text", "detections.txt", _detections, "mot", (), 1),
    ("detections as CSV", "detections.csv", _detections, "detections", _PLACES, 1),
    ("positions CSV", "p.csv", lambda path: _check_finite(read_positions(path).east_north_m), "positions", _PLACES, 1),
    ("landmarks CSV", "landmarks.csv", _landmarks, "landmarks", _PLACES, 1),
    ("measurements CSV", "measured.csv", _measurements, "measurements", (), 0.5),
    ("poses CSV", "poses.csv", _poses, "poses", _PLACES, 1),
    (
        "camera TOML",
        "camera.toml",
        lambda path: (camera_files.describe_missing(path), camera_files.read_camera(path)),
        "camera",
        _TOML,
        1,
    ),
    ("colours TOML", "colours.toml", read_colours, "colours", _TOML, 1),
    ("settings TOML", "settings.toml", lambda path: changes(load_config(path)), "settings", _TOML, 1),
    ("overrides", "override.txt", _overrides, "overrides", ("=", ".", "world.side_m=1", "crowd.1.people=2"), 1),
    ("scenario TOML", "scenario.toml", _scenario, "scenario", _TOML, 1),
    ("telemetry CSV", "flight.csv", _telemetry, "own telemetry", _PLACES, 1),
    (
        "tables of other programs",
        "flight.csv",
        _telemetry,
        "program telemetry",
        ("frame", "date", "(rad)", "[ft]", "sep=;\n", "gps", "1e7", "AM", "26/08/2022"),
        1,
    ),
    (
        "SRT",
        "a.SRT",
        _telemetry,
        "subtitles",
        ("-->", "GPS(", "[latitude:", "H 5m", "00:00:01,000 --> ", "[Drone: ", "SrtCnt", "zoom: 1790"),
        1,
    ),
    ("NMEA 0183", "track.nmea", _telemetry, "nmea", ("$GPGGA,", "*00", "$", "A", "V", "W"), 1),
    ("classifier as text", "a.txt", _classifier, "classifier text", (), 0.3),
    ("addresses to serve at", "address.txt", _address, "addresses", (), 0.3),
    ("names of streams", "stream.txt", _stream_word, "streams", ("json:", "cot:"), 0.3),
    ("names of inputs", "input.txt", _input_name, "input names", (), 0.5),
    ("other words", "words.txt", _other_words, "other words", ("camera:", "://", "@"), 1),
    ("studies", "study.toml", read_spec, "studies", (*_TOML, "[[dataset]]", "kind = ", "folder = "), 1),
)
# Name, file, what is done, seeds and what they are given, a library that is needed, share.
_BYTES: tuple[tuple[str, str, Callable[[Path], object], Callable[..., Sequence[bytes]], tuple, str, float], ...] = (
    ("MISB ST 0601 in MPEG-TS", "video.ts", _telemetry, seeds.klv, (True,), "", 1),
    ("KLV", "flight.klv", _telemetry, seeds.klv, (False,), "", 1),
    ("MAVLink tlog", "flight.tlog", _telemetry, seeds.mavlink, (), "pymavlink", 1),
    ("PX4 ULog", "flight.ulg", _telemetry, seeds.px4, (), "pyulog", 0.7),
    ("ArduPilot DataFlash", "flight.bin", _telemetry, seeds.ardupilot, (False,), "", 1),
    ("ArduPilot DataFlash as text", "flight.log", _telemetry, seeds.ardupilot, (True,), "", 1),
    *(
        ("classifier " + e, "a" + e, _classifier, seeds.classifiers, (e,), "", 0.3)
        for e in (".npy", ".npz", ".yml", ".xml", ".json")
    ),
    ("folder of PNGs", "clip/frame2.png", _folder, seeds.pictures, (".png", True), "", 1),
    ("folder of JPEGs", "clip/frame1.jpg", _folder, seeds.pictures, (".jpg",), "", 1),
    ("folder of TIFFs", "clip/frame1.tif", _folder, seeds.pictures, (".tiff", True), "", 1),
    ("folder of BMPs", "clip/a.bmp", _folder, seeds.pictures, (".bmp",), "", 0.5),
    ("folder of other images", "clip/a.ppm", _folder, seeds.pictures, (".ppm",), "", 0.5),
    ("masks", "000001.png", truth.read_mask, seeds.pictures, (".png", True), "", 0.5),
    ("video .avi", "a.avi", _video, seeds.videos, (".avi", "MJPG"), "", 0.15),
    ("video .mp4", "a.mp4", _video, seeds.videos, (".mp4", "mp4v"), "", 0.15),
    ("video H.264", "a.mp4", _video, seeds.videos, (".mp4", "libx264"), "av", 0.15),
    (
        "elevation",
        "a.tif",
        lambda path: read_elevation(path, _CORNERS, None, margin_m=30),
        seeds.raster,
        (1,),
        "rasterio",
        0.3,
    ),
    ("photo", "a.tif", lambda path: read_ortho(path, _CORNERS, None, margin_m=30), seeds.raster, (3,), "rasterio", 0.3),
)
_OPENCV = ("a.yml", "a.xml", "a.json")
_CONFIG = (
    "function seqs=configSeqs\n\nseqUAV123 = {struct('name','car_1','path','D:\\data_seq\\UAV123\\car\\',"
    "'startFrame',1,'endFrame',3,'nz',6,'ext','jpg','init_rect',[0,0,0,0])};\n"
)
_VIVID = "name,frame,id,x,y,w,h\ncar,0,7,1,2,8,5\ntruck,0,9,15,2,8,5\ncar,1,7,3,2,8,5\n"
_OF_2017 = "1,1,1,2,30,40,1,1,1\n1,2,100,20,30,40,0,2,0.5\n2,1,2,2,30,40,1,1,0.8\n3,5,40,20,30,40,0,3,1\n"
_GT = "UAV-benchmark-MOTD_v1.0/GT/M1_gt_"
# Name, kind, clip, file, contents besides those of a good clip.
_DATA_SETS: tuple[tuple[str, str, str, str, Sequence[str]], ...] = (
    ("MOTChallenge's gt.txt", "motchallenge", "S", "S/gt/gt.txt", [_OF_2017]),
    ("MOTChallenge's seqinfo.ini", "motchallenge", "S", "S/seqinfo.ini", []),
    ("VisDrone-MOT", "visdrone", "a", "annotations/a.txt", []),
    ("UAVDT's truth", "uavdt", "M1", f"{_GT}whole.txt", []),
    ("UAVDT's ignored regions", "uavdt", "M1", f"{_GT}ignore.txt", ["1,1,20,0,10,10,1,-1,-1\n"]),
    ("Stanford Drone", "sdd", "a-b", "annotations/a/b/annotations.txt", []),
    ("CVML", "cvml", "a", "a.xml", []),
    ("KITTI's label_02", "kitti", "0", "training/label_02/0.txt", []),
    ("INRIA's annotations", "inria", "a", "Test/annotations/a.txt", []),
    ("BMS's definition", "bms", "cars", "Trainingset/cars/GroundTruth/carsDef.dat", []),
    ("CDnet's temporal region", "cdnet", "PTZ-zoom", "PTZ/zoom/temporalROI.txt", ["2\t2"]),
    ("UAV123's boxes", "uav123", "bike1", "anno/UAV123/bike1.txt", []),
    ("UAV123's clips", "uav123", "car", "configSeqs.m", [_CONFIG]),
    ("VIVID's vehicles", "vivid", "egtest01", "egtest01_truth.csv", [_VIVID]),
    ("VIVID's target", "vivid", "egtest01", "egtest01_gt.txt", ["1,2,8,5\n" * 21]),
)
_WORDS = {
    "motchallenge": ("imDir=..", "%(name)s", "frameRate=nan", "[DEFAULT]"),
    "sdd": ('"Biker"', "Car", '"'),
    "cvml": ("<frame", "</objectlist>", 'id="', "&amp;", "&a;", "<!DOCTYPE a [", 'encoding="utf-7"', "]]>", "<box/>"),
    "kitti": ("DontCare", "Car", "-1000", "1e9"),
    "inria": ("(Xmin, Ymin)", "object 3", "-99999999", "Image size (X x Y x C) :"),
    "bms": ("File name:", "Frame number:", "Scale of region 1:", "../../a.pgm", "/"),
    "uav123": ("NaN,NaN,NaN,NaN", "'startFrame',", "'endFrame',9", "'name','..'", "'path','/'"),
}


def _beside(file: str) -> Mapping[str, bytes]:
    """The other files of a clip or a folder of pictures."""
    if file.startswith(("true/", "found/")):
        return {name: content for name, content in _CLIP.items() if name != file}
    if file == "clip/frame2.png":
        return {"clip/frame1.png": seeds.pictures(".png")[0], "clip/frame3.png": seeds.pictures(".png")[1]}
    return {"clip/frame2.jpg": seeds.pictures(".jpg")[0]} if file == "clip/frame1.jpg" else {}


def _data_set(name: str, kind: str, clip: str, file: str, more: Sequence[str]) -> Parser:
    """A data set of which one file is damaged."""

    def files() -> dict[str, bytes]:
        own = {} if file != "configSeqs.m" else {f"anno/UAV123/{clip}_1.txt": b"1,2,30,4\nNaN,NaN,NaN,NaN\n3,2,30,4\n"}
        return {f"{ROOT}/{path}": content for path, content in {**seeds.data_set(kind, clip), **own}.items()}

    def whole() -> list[bytes]:
        return [content for path, content in files().items() if path == f"{ROOT}/{file}"] + [m.encode() for m in more]

    return Parser(name, f"{ROOT}/{file}", whole, partial(_dataset, kind), _WORDS.get(kind, ()), 0.5, beside=files)


PARSERS: tuple[Parser, ...] = (
    *(
        Parser(name, file, partial(seeds.text, kind), read, words, share, beside=partial(_beside, file))
        for name, file, read, kind, words, share in _TEXTS
    ),
    *(
        Parser(name, file, partial(make, *given), read, (), share, file in _OPENCV, partial(_beside, file), needs)
        for name, file, read, make, given, needs, share in _BYTES
    ),
    Parser(
        *("manifest of graphs", "manifest.json", lambda: [(SHIPPED / MANIFEST).read_bytes()]),
        lambda path: find_graphs(PeopleParameters(graphs=str(path.parent))),
        beside=lambda: {path.name: path.read_bytes() for path in SHIPPED.glob("people_*.onnx")},
    ),
    *(_data_set(*row) for row in _DATA_SETS),
)
