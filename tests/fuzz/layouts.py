"""Whole data sets, small: of each the file that is damaged, and what lies about it."""

from collections.abc import Mapping, Sequence
from functools import cache
from typing import NamedTuple

from tests.fuzz import seeds

ROOT = "set"
"""The data set's folder."""


class Layout(NamedTuple):
    """A file of a data set. kind: of it. file: in its folder. whole: contents of the file. beside: other files.

    pictures: names of pictures of 32 x 24 pixels. words: what means something in the file.
    """

    name: str
    kind: str
    file: str
    whole: Sequence[str]
    pictures: Sequence[str] = ()
    beside: Mapping[str, str] = {}
    words: Sequence[str] = ()

    def seeds(self) -> Sequence[bytes]:
        """The whole files."""
        return [text.encode() for text in self.whole]

    def others(self) -> Mapping[str, bytes]:
        """The other files of the data set."""
        text = {name: content.encode() for name, content in self.beside.items()}
        return {f"{ROOT}/{name}": content for name, content in {**text, **_pictures(tuple(self.pictures))}.items()}


@cache
def _pictures(names: tuple[str, ...]) -> dict[str, bytes]:
    grey = b"P5 32 24 255\n" + bytes(32 * 24)
    return {name: grey if name.endswith(".pgm") else seeds.pictures(f".{name.rsplit('.', 1)[1]}")[0] for name in names}


def _numbered(pattern: str, count: int, first: int = 1) -> list[str]:
    return [pattern.format(number) for number in range(first, first + count)]


_OF_2015 = "1,1,1,2,30,40,1,4.5,-7.5,0\n2,1,2,2,30,40,1,4.6,-7.5,0\n2,2,60,20,30,40,0,-1,-1,-1\n"
_OF_2017 = "1,1,1,2,30,40,1,1,1\n1,2,100,20,30,40,0,2,0.5\n2,1,2,2,30,40,1,1,0.8\n3,5,40,20,30,40,0,3,1\n"
_INI = "[Sequence]\nname=S\nimDir=img1\nframeRate=25\nseqLength=3\nimWidth=32\nimHeight=24\nimExt=.png\n"
_VISDRONE = "1,1,2,3,4,5,1,1,0,0\n1,0,20,0,10,10,0,0,0,0\n2,2,12,3,4,5,1,4,0,1\n2,9,0,0,8,8,1,11,0,0\n"
_UAVDT = "1,1,2,3,4,5,1,1,1\n2,1,3,3,4,5,1,1,1\n2,2,12,13,4,5,1,2,3\n"
_SDD = '0 10 20 18 30 0 0 0 0 "Pedestrian"\n0 11 20 19 30 1 0 1 1 "Pedestrian"\n3 1 2 5 6 0 1 0 0 "Biker"\n'
_CVML = (
    '<?xml version="1.0" encoding="utf-8"?>\n<dataset name="PETS">\n<frame number="0"><objectlist>'
    '<object id="1"><orientation>90</orientation><box h="10" w="4" xc="10.5" yc="20"/></object>'
    '<object id="2"><box h="10" w="4" xc="25" yc="20"/></object></objectlist></frame>\n<frame number="1">'
    '<objectlist><object id="1"><box h="10" w="4" xc="11" yc="20"/></object></objectlist></frame>\n</dataset>\n'
)
_KITTI = (
    "0 0 Car 0 0 -1.5 10 5 14 10 1.5 1.6 3.7 -2 1.6 20 0.1\n0 -1 DontCare -1 -1 -10 20 0 30 20 -1 -1 -1 -1000 -1000 "
    "-1000 -10\n1 0 Car 0 1 -1.5 11 5 15 10 1.5 1.6 3.7 -2 1.6 19 0.1\n1 1 Pedestrian 1 0 0 1 5 3 10 1 1 1 0 1 9 0\n"
)
_CALIBRATION = (
    "P2: 7.2 0 6 4 0 7.2 1 2 0 0 1 2\nR_rect 1 0 0 0 1 0 0 0 1\n"
    "Tr_velo_cam 0 -1 0 0 0 0 -1 0 1 0 0 0\nTr_imu_velo 1 0 0 -1 0 1 0 0 0 0 1 0\n"
)
_RECORDS = "49.01 8.43 112.8 0.02 0.01 -1.2 -3 4 5 0\n49.0101 8.4301 112.8 0.02 0.01 -1.21 -3 4 5 0\n"
_PASCAL = (
    '# PASCAL Annotation Version 1.00\n\nImage filename : "Test/pos/a.png"\nImage size (X x Y x C) : 32 x 24 x 3\n'
    'Objects with ground truth : 2 { "PASperson" "PASperson" }\n\n# Top left pixel co-ordinates : (0, 0)\n\n'
    'Bounding box for object 1 "PASperson" (Xmin, Ymin) - (Xmax, Ymax) : (10, 2) - (19, 21)\n'
    'Bounding box for object 2 "PASperson" (Xmin, Ymin) - (Xmax, Ymax) : (20, 2) - (29, 21)\n'
)
_DEFINITION = (
    "Ground truth definition file; do not change!\n\nTotal number of regions:\n2\n\nScale of region 0:\n0\n\n"
    "Scale of region 1:\n255\n\nConfusion penality matrix:\n0 1\n1 0\n\nTotal number of frames in this shot:\n2\n\n"
    "Total number of labeled frames for this shot:\n1\n\nFrame number:\n0\n\nFile name:\ncars_01.pgm\n\n"
    "Input file name:\ncars_01.ppm\n"
)
_BOXES = "1,2,30,4\nNaN,NaN,NaN,NaN\n3,2,30,4\n"
_CONFIG = (
    "function seqs=configSeqs\n\nseqUAV123 = {struct('name','car_1','path','D:\\data_seq\\UAV123\\car\\',"
    "'startFrame',1,'endFrame',3,'nz',6,'ext','jpg','init_rect',[0,0,0,0])};\n"
)
_VIVID = "name,frame,id,x,y,w,h\ncar,0,7,1,2,8,5\ntruck,0,9,15,2,8,5\ncar,1,7,3,2,8,5\n"

_UAVDT_TRUTH, _TRAINING = "UAV-benchmark-MOTD_v1.0/GT/M0101", "training"
_UAVDT_PICTURES = _numbered("UAV-benchmark-M/M0101/img{:06d}.png", 2)
_KITTI_PICTURES = _numbered("training/image_02/0000/{:06d}.png", 2, 0)
_KITTI_FILES = {
    "training/label_02/0000.txt": _KITTI,
    "training/calib/0000.txt": _CALIBRATION,
    "training/oxts/0000.txt": _RECORDS,
}


def _kitti(part: str) -> Layout:
    file = f"{_TRAINING}/{part}/0000.txt"
    others = {name: content for name, content in _KITTI_FILES.items() if name != file}
    words = ("DontCare", "Car", "R_rect", "Tr_velo_cam", "-1000", "1e9")
    return Layout(f"KITTI's {part}", "kitti", file, [_KITTI_FILES[file]], _KITTI_PICTURES, others, words)


LAYOUTS: tuple[Layout, ...] = (
    Layout(
        "MOTChallenge's gt.txt", "motchallenge", "S/gt/gt.txt", [_OF_2015, _OF_2017], beside={"S/seqinfo.ini": _INI},
    ),
    Layout(
        "MOTChallenge's seqinfo.ini", "motchallenge", "S/seqinfo.ini", [_INI],
        _numbered("S/img1/{:06d}.png", 3), {"S/gt/gt.txt": _OF_2017},
        ("imDir=..", "%(name)s", "frameRate=nan", "[DEFAULT]"),
    ),
    Layout("VisDrone-MOT", "visdrone", "annotations/a.txt", [_VISDRONE], _numbered("sequences/a/{:07d}.png", 2)),
    Layout(
        "UAVDT's truth", "uavdt", f"{_UAVDT_TRUTH}_gt_whole.txt", [_UAVDT], _UAVDT_PICTURES,
        {f"{_UAVDT_TRUTH}_gt_ignore.txt": "1,1,20,0,10,10,1,-1,-1\n"},
    ),
    Layout(
        "UAVDT's ignored regions", "uavdt", f"{_UAVDT_TRUTH}_gt_ignore.txt", ["1,1,20,0,10,10,1,-1,-1\n"],
        _UAVDT_PICTURES, {f"{_UAVDT_TRUTH}_gt_whole.txt": _UAVDT},
    ),
    Layout("Stanford Drone", "sdd", "a/annotations.txt", [_SDD], words=('"Biker"', "Car", '"')),
    Layout(
        "CVML", "cvml", "a.xml", [_CVML], _numbered("a/frame_{:04d}.png", 2, 0),
        words=("<frame", "</objectlist>", 'id="', "&amp;", "&a;", "<!DOCTYPE a [", 'encoding="utf-7"', "]]>", "<box/>"),
    ),
    _kitti("label_02"),
    _kitti("calib"),
    _kitti("oxts"),
    Layout(
        "INRIA's annotations", "inria", "Test/annotations/a.txt", [_PASCAL], ["Test/pos/a.png"],
        words=("(Xmin, Ymin)", "object 3", "-99999999", "Image size (X x Y x C) :"),
    ),
    Layout(
        "BMS's definition", "bms", "cars/carsDef.dat", [_DEFINITION],
        ["cars/cars_01.ppm", "cars/cars_02.ppm", "cars/cars_01.pgm"],
        words=("File name:", "Frame number:", "Scale of region 1:", "../../a.pgm", "/"),
    ),
    Layout(
        "CDnet's temporal region", "cdnet", "PTZ/zoom/temporalROI.txt", ["1 2\n", "2\t2"],
        [*_numbered("PTZ/zoom/input/in{:06d}.jpg", 2), *_numbered("PTZ/zoom/groundtruth/gt{:06d}.png", 2)],
    ),
    Layout(
        "UAV123's boxes", "uav123", "anno/UAV123/bike1.txt", [_BOXES], _numbered("data_seq/UAV123/bike1/{:06d}.jpg", 3),
        words=("NaN,NaN,NaN,NaN",),
    ),
    Layout(
        "UAV123's clips", "uav123", "configSeqs.m", [_CONFIG], _numbered("data_seq/UAV123/car/{:06d}.jpg", 3),
        {"anno/UAV123/car_1.txt": _BOXES}, ("'startFrame',", "'endFrame',9", "'name','..'", "'path','/'"),
    ),
    Layout(
        "VIVID's vehicles", "vivid", "egtest01/egtest01_truth.csv", [_VIVID],
        _numbered("egtest01/frame{:05d}.jpg", 2, 0),
    ),
    Layout(
        "VIVID's target", "vivid", "egtest01_gt.txt", ["0 1 2 8 5\n1 NaN NaN NaN NaN\n", "1,2,8,5\n2,2,8,5\n"],
        _numbered("egtest01/frame{:05d}.jpg", 2, 0),
    ),
)  # fmt: skip
