"""Small data sets on disk, one clip of each kind in its layout, and what reading them gives."""

import json
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from torchvision_dddas.lab.evaluation.datasets import kinds
from torchvision_dddas.lab.evaluation.datasets.record import Clip, Dataset, DatasetSource
from torchvision_dddas.lab.simulation.truth import COLUMNS

SIZE = (32, 24)  # of pictures and masks, px

Box = tuple[int, int, int, int]
CAR, MAN = (2, 2, 8, 8), (20, 10, 6, 10)
WHITE, RED = 0xFFFFFF, 0xFF0000


def read(kind: str, folder: Path, clips: Iterable[str] = ("*",), **options: Any) -> Dataset:
    """The data set that a study's file would name so."""
    return kinds.read(DatasetSource(kind, folder, tuple(clips), options), Path())


def clip(kind: str, folder: Path, **options: Any) -> Clip:
    """The one clip of a data set of which nothing is missing."""
    found = read(kind, folder, **options)
    assert found.missing == ()
    (only,) = found.clips
    return only


def complaint(kind: str, folder: Path, **options: Any) -> str:
    """The one line of a data set without a clip."""
    found = read(kind, folder, **options)
    assert found.clips == ()
    (line,) = found.missing
    assert line.isprintable()
    return line


def write(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    ok, content = cv2.imencode(path.suffix, image)
    assert ok
    path.write_bytes(content.tobytes())


def pictures(folder: Path, names: Iterable[str], size: tuple[int, int] = SIZE) -> None:
    """Pictures of these names, each with its own brightness."""
    for number, name in enumerate(names):
        depth = () if name.endswith(".pgm") else (3,)
        write(folder / name, np.full((size[1], size[0], *depth), 10 + number % 200, np.uint8))


def numbered(folder: Path, count: int, name: str = "{:06d}.png", first: int = 1) -> None:
    pictures(folder, [name.format(number) for number in range(first, first + count)])


def mask(path: Path, regions: Mapping[Box, int], size: tuple[int, int] = SIZE, ground: int = 0) -> None:
    """A mask with boxes (x, y, width, height) of values, colours of one number in a PPM; ground: of all else."""
    values = np.full((size[1], size[0]), ground, np.int64)
    for (x, y, w, h), value in regions.items():
        values[y : y + h, x : x + w] = value
    colours = np.stack([values & 255, values >> 8 & 255, values >> 16 & 255], axis=-1)
    write(path, (colours if path.suffix == ".ppm" else values).astype(np.uint8))


def text(path: Path, content: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(content, encoding="utf-8")
    return path


def video(path: Path, frames: int) -> None:
    """A video, 10 frames a second."""
    path.parent.mkdir(parents=True, exist_ok=True)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 10.0, SIZE)
    for number in range(frames):
        writer.write(np.full((SIZE[1], SIZE[0], 3), 10 + number, np.uint8))
    writer.release()


# -- a clip of each kind -----------------------------------------------------------------------------------------------


def folder(home: Path, name: str) -> None:
    numbered(home / name / "frames", 3, "{}.png", first=0)
    mask(home / name / "masks" / "1.png", {CAR: 1})


def davis(home: Path, name: str) -> None:
    for n in range(3):
        pictures(home / "JPEGImages/480p" / name, [f"{n:05d}.jpg"])
        mask(home / "Annotations/480p" / name / f"{n:05d}.png", {CAR: 255})


def cdnet(home: Path, name: str, region: str = "3 5") -> None:
    category, video = name.split("-")
    place = home / category / video
    numbered(place / "input", 6, "in{:06d}.jpg")
    for n in range(1, 7):
        regions = {(0, 0, 4, 24): 85, (10, 10, 6, 6): 170, (11, 11, 4, 4): 255, (20, 10, 3, 3): 50}
        mask(place / "groundtruth" / f"gt{n:06d}.png", regions)
    text(place / "temporalROI.txt", region)


def definition(regions: list[int], frames: int, labelled: Mapping[str, str]) -> str:
    """A definition file of Berkeley motion segmentation. labelled: picture -> file of its labels."""
    scales = "".join(f"Scale of region {k}:\n{value}\n" for k, value in enumerate(regions))
    files = "".join(
        f"Frame number:\n{k}\nFile name:\n{file}\nInput file name:\n{picture}\n"
        for k, (picture, file) in enumerate(labelled.items())
    )
    return (
        f"Ground truth definition file; do not change!\n\nTotal number of regions:\n{len(regions)}\n{scales}\n"
        f"Confusion penality matrix:\n0 1\n1 0\n\nTotal number of frames in this shot:\n{frames}\n"
        f"Total number of labeled frames for this shot:\n{len(labelled)}\n{files}"
    )


def bms(home: Path, name: str) -> None:
    place = home / "Trainingset" / name
    numbered(place, 5, name + "_{:02d}.jpg")
    labelled = {f"{name}_01.ppm": f"{name}_0001_gt.ppm", f"{name}_04.ppm": f"{name}_0004_gt.ppm"}
    text(place / "GroundTruth" / f"{name}Def.dat", definition([WHITE, RED, 0], 5, labelled))
    for file in labelled.values():
        mask(place / "GroundTruth" / file, {CAR: RED, MAN: 0, (0, 0, 1, 1): 0x123456}, ground=WHITE)
        mask(place / "GroundTruth" / file.replace("_gt.ppm", "_PROB_gt.pgm"), {CAR: 9})


def uav123(home: Path, name: str, variant: str = "UAV123") -> None:
    numbered(home / "data_seq" / variant / name, 4, "{:06d}.jpg")
    text(home / "anno" / variant / f"{name}.txt", "1,2,30,4\nNaN,NaN,NaN,NaN\n3,2,30,4\n4,2,30,4\n")


def vivid(home: Path, name: str) -> None:
    numbered(home / name, 21, "frame{:05d}.jpg", first=0)
    text(home / f"{name}_gt.txt", "0 1 2 8 5\n10 3 2 8 5\n20 NaN NaN NaN NaN\n")


OF_2015 = (
    "1,1,10,20,30,40,1,4.5,-7.5,0\n2,1,11,20,30,40,1,4.6,-7.5,0\n2,2,60,20,30,40,0,1,1,0\n3,2,61,20,30,40,1,-1,-1,-1\n"
)


def motchallenge(home: Path, name: str, gt: str = OF_2015) -> None:
    text(home / name / "seqinfo.ini", "[Sequence]\nimDir=img1\nframeRate=25\nseqLength=3\n")
    text(home / name / "gt/gt.txt", gt)
    numbered(home / name / "img1", 3)


def visdrone(home: Path, name: str, rows: str = "1,1,2,3,4,5,1,1,0,0\n2,2,12,3,4,5,1,4,0,1\n") -> None:
    numbered(home / "sequences" / name, 2, "{:07d}.png")
    text(home / "annotations" / f"{name}.txt", rows)


def uavdt(home: Path, name: str) -> None:
    numbered(home / "UAV-benchmark-M" / name, 2, "img{:06d}.png")
    rows = "1,1,2,3,4,5,1,1,1\n2,1,3,3,4,5,1,1,1\n2,2,12,13,4,5,1,2,3\n"
    text(home / "UAV-benchmark-MOTD_v1.0/GT" / f"{name}_gt_whole.txt", rows)


def cvml_text(*frames: str, first: int = 0) -> str:
    inside = "".join(
        f'<frame number="{n}"><objectlist>{boxes}</objectlist></frame>' for n, boxes in enumerate(frames, first)
    )
    return f'<?xml version="1.0" encoding="utf-8"?><dataset name="PETS">{inside}</dataset>'


CVML_BOX = '<object id="{0}"><box h="10" w="4" xc="{1}" yc="20"/></object>'


def cvml(home: Path, name: str) -> None:
    rows = CVML_BOX.format(1, 10) + CVML_BOX.format(2, 15), "", CVML_BOX.format(1, 11)
    text(home / f"{name}.xml", cvml_text(*rows))
    numbered(home / name, 3, "frame_{:04d}.png", first=0)


WALKERS = (
    '0 10 20 18 30 0 0 0 0 "Pedestrian"\n0 11 20 19 30 1 0 1 1 "Pedestrian"\n0 0 20 8 30 2 1 0 0 "Pedestrian"\n'
    '3 1 2 5 6 0 0 0 0 "Biker"\n'
)


def sdd(home: Path, name: str) -> None:
    scene, number = name.split("-")
    text(home / "annotations" / scene / number / "annotations.txt", WALKERS)
    video(home / "videos" / scene / number / "video.mov", 3)


def kitti_label(
    frame: int, identity: int, kind: str = "Car", truncated: int = 0, occluded: int = 0, x: int = 10
) -> str:
    return f"{frame} {identity} {kind} {truncated} {occluded} -1 {x} 5 {x + 4} 10 1.5 1.6 3.7 -2 1.6 20 0.1\n"


def kitti(home: Path, name: str, labels: str = "") -> None:
    numbered(home / "training/image_02" / name, 2, first=0)
    text(home / "training/label_02" / f"{name}.txt", labels or kitti_label(0, 0) + kitti_label(1, 0))


INRIA_BOX = (
    'Original label for object 1 "PASperson" : "UprightPerson"\n'
    'Bounding box for object 1 "PASperson" (Xmin, Ymin) - (Xmax, Ymax) : (10, 2) - (19, 21)\n'
)


def inria_text(size: tuple[int, int] = SIZE, boxes: int = 1, announced: int | None = None, origin: int = 0) -> str:
    return (
        f"# PASCAL Annotation Version 1.00\n\nImage size (X x Y x C) : {size[0]} x {size[1]} x 3\n"
        'Database : "The INRIA Rhône-Alpes Annotated Person Database"\n'
        f'Objects with ground truth : {boxes if announced is None else announced} {{ "PASperson" }}\n\n'
        f"# Top left pixel co-ordinates : ({origin}, {origin})\n\n{INRIA_BOX * boxes}"
    )


def inria(home: Path, name: str) -> None:
    """A picture of a person, of a size of its own for each first letter, and one without."""
    size = (SIZE[0] + ord(name[0]) - ord("a"), SIZE[1])
    pictures(home / "Test/pos", [f"{name}.png"], size)
    (home / "Test/annotations").mkdir(exist_ok=True)
    (home / f"Test/annotations/{name}.txt").write_text(inria_text(size), encoding="latin-1")
    pictures(home / "Test/neg", ["n.png"])


PLACES = (
    ",".join(COLUMNS) + "\n"
    "1,1,person,3,10,20,7.1,50.1,0,0,64\n"
    "1,2,ugv,0,11,20,7.1,50.1,0,0,80\n"
    "1,3,person,3,90,20,7.2,50.1,0,0,0\n"
    "2,1,person,3,10.5,20,7.1,50.1,0,0,64\n"
)
INSTRUMENTS = ("telemetry.csv", "landmarks.csv", "colours.toml", "camera.toml", "dem.tif")


def simulated(home: Path, name: str) -> None:
    place = home / name
    numbered(place / "frames", 2, "{:06d}.jpg")
    for n in (1, 2):
        mask(place / "truth/masks" / f"00000{n}.png", {CAR: 1, (20, 10, 10, 8): 2})
    text(place / "truth/gt.txt", "1,1,2,2,8,8,1,-1,-1,-1\n1,4,12,2,3,3,0,-1,-1,-1\n2,1,2,2,8,8,1,-1,-1,-1\n")
    text(place / "truth/positions.csv", PLACES)
    text(place / "run.json", json.dumps({"state": "complete", "clip": {"rate_hz": 12.5}}))
    for file in INSTRUMENTS:
        text(place / file, "x")


# Each writes a clip of a name into the folder of a data set of its kind.
MAKE: dict[str, Callable[[Path, str], None]] = {
    make.__name__: make
    for make in (
        folder, davis, cdnet, bms, uav123, vivid, motchallenge, visdrone, uavdt, cvml, sdd, kitti, inria, simulated,
    )
}  # fmt: skip

# Names of two clips, where a kind needs others than "good" and "bad".
GOOD = {"cdnet": "PTZ-good", "sdd": "quad-good", "inria": "a"}
BAD = {"cdnet": "PTZ-bad", "sdd": "quad-bad", "inria": "b"}
