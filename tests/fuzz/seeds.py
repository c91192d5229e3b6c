"""Whole files of every kind that is read, small, from which damaged ones are made."""

import tempfile
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path

import cv2
import numpy as np

from tests.io.clips import write_by_av, write_video
from tests.io.flights import (
    attitude,
    dataflash,
    dataflash_text,
    eastward,
    packet,
    sentence,
    spread,
    tlog,
    transport_stream,
    ulog,
)
from tests.lab.evaluation.datasets.layouts import MAKE

FEATURES = 3780
"""Of the descriptor that the classifiers here fit."""


def _subtitles(body: str) -> str:
    return "".join(f"{i + 1}\n00:00:0{i},000 --> 00:00:0{i + 1},000\n{body.format(i=i)}\n\n" for i in range(5))


def _rows(header: str, row: str, count: int = 8) -> str:
    return header + "\n" + "".join(row.format(i=i, even=160 + i) + "\n" for i in range(count))


_RMC = "GNRMC,12003{i}.50,A,4807.0380,N,01131.0000,W,10.0,084.4,230394,003.1,W"
_NMEA = ("GPGGA,12003{i}.50,4807.0380,N,01131.0000,W,1,08,0.9,545.4,M,46.9,M,,", _RMC, "HEHDT,274.0,T")
_UNCHECKED = ("$GPGLL,4807.038,N,01131.000,E,12003{i},A", f"${_RMC}", "$GPVTG,084.4,T,081.3,M,010.0,N,018.5,K")
_COVARIANCE = "var_east_m2,cov_east_north_m2,var_north_m2"
TEXT: dict[str, tuple[str, ...]] = {
    "mot": (
        "1,1,10,20,30,40,0.9,-1,-1,-1\n1,2,60,20,30.5,40,1,-1,-1,-1\n2,1,11,20,30,40,0,-1,-1,-1\n3,2,60,21,30,40,1\n",
        "".join(f"{k},-1,{k}.5,{2 * k},30,40,0.{k}\n" for k in range(1, 9)),
        "1 1 10 20 30 40\n\n2 1 12 20 30 40\n",
        "10,20,30,40\n11,20,30,40\nnan,nan,nan,nan\n12 20 30 40\n",
    ),
    "detections": (
        ("frame,x_px,y_px,width_px,height_px,score,identity,cut,feet_u_px,feet_v_px\n1,10,20,30,40,0.9,1,0,25,59.5\n"
        "2,11,20,30,40,0.8,1,1,,\n3,12,20,30,40,0.7,,0,27,59\n"),
        "frame,identity,x_px,y_px,width_px,height_px,score,kind,row,speed_px_per_frame\n1,1,1,2,3,4,0.5,moving,1,2.5\n",
    ),
    "positions": (
        (f"frame,target,east_m,north_m,{_COVARIANCE},longitude_deg,latitude_deg,score\n"
        "1,1,0.5,1.5,1,0.1,1,-110.95,32.23,0.9\n2,1,0.6,1.5,1,0.1,1,-110.95,32.23,\n2,2,8,9,,,,-110.95,32.23,1\n"),
        "frame,target,east_m,north_m\n1,1,0,0\n5,2,1e3,-2\n",
    ),
    "landmarks": (
        ("frame,landmark,u_px,v_px,longitude_deg,latitude_deg,sigma_m,planned\n1,red,10,20,-110.95,32.23,1.5,0\n"
        "1,blue,300,20,-110.951,32.23,,\n2,red,11,20,-110.95,32.23,1.5,0\n2,blue,,,-110.951,32.231,2,1\n"),
        "time_s,landmark,u_px,v_px,east_m,north_m\n0.0,1,10,20,0,0\n0.0,2,90,20,10,0\n0.1,1,10,21,0,0\n0.1,2,,,,\n",
    ),
    "measurements": ("distance_m,height_px\n10,180\n20,91\n\n30.5,60\n", "height_px, distance_m ,note\n180,10,x\n"),
    "poses": (
        "frame,east_m,north_m,heading_deg,pitch_deg\n1,0,0,10,1\n5,1,0.5,350,2\n9,2,1,355,2\n",
        "time_s,longitude_deg,latitude_deg,heading_deg\n0,179.9999,32,10\n0.5,-179.9999,32,15\n2,-179.9998,32.0001,20\n",
    ),
    "camera": (
        ('name = "front"\nfocal_px = 1195\nwidth_px = 768\nheight_px = 576\nheight_m = 1.2\npitch_deg = 3.0\n'
        "heading_deg = 54.3\nlongitude_deg = -110.95\nlatitude_deg = 32.23\ncentre_px = [383.5, 287.5]\nk1 = -0.1\n"),
        "hfov_deg = 60\nwidth_px = 640\nheight_px = 480\neast_m = 1\nnorth_m = 2\nheading_sigma_deg = 3\n",
    ),
    "colours": (
        "[red]\nlow = [172, 90, 60]\nhigh = [8, 255, 255]\n\n[blue]\nlow = [100, 90, 60]\nhigh = [125, 255, 255]\n",
    ),
    "settings": (
        ('[registration]\nmodel = "affine"\nkeypoints = 300\nquality = 0.02\n[interval]\nminimum_frames = 1\n[small]\n'
        "on = true\n[live]\npace = 2.0\n[people]\nwindow_width_px = 64\nbins = 9\n[track]\nbirth_doubt = 4.0\n"),
    ),
    "overrides": ("registration.keypoints=500", "small.on=true", "registration.model=affine"),
    "scenario": (
        ('about = "a crowd and faults"\nseed = 7\n[clip]\nseconds = 20.0\n[world]\nside_m = 120.0\n[uav]\n'
        "altitude_m = 40.0\nstart_m = [-10.0, 0.0]\nway_m = [[10.0, 0.0], [0.0, 5.0]]\n[team]\nugvs = 4\n"
        "middle_m = [0.0, 0.0]\n[[crowd]]\npeople = 8\nstart_m = [-14.0, -20.0]\nway_m = [[0.0, 0.0]]\n[[crowd]]\n"
        'people = 3\n[[car]]\nstart_m = [-40.0, 11.0]\n[[happening]]\ntime_s = 5.0\nwhat = "join"\ncrowds = [1, 2]\n'
        '[[fault]]\nwhat = "gps_dropout"\ntime_s = 3.0\nvehicle = 2\n[settings.registration]\nkeypoints = 300\n'),
    ),
    "own telemetry": (
        _rows("time_s,altitude_m,speed_m_s", "{i},{even},5"),
        _rows(
            "time_s,above_sea_m,longitude_deg,latitude_deg,heading_deg,pitch_deg,roll_deg,hfov_deg,vehicle_heading_deg",
            "0.{i},150,-110.95{i},32.23,35{i},90,0.5,60,10",
        ),
        "time_s,altitude_m,east_m,north_m\n0,50,0,0\n1,,1,0\n2,52,,\n9,52,3,0\n",
    ),
    "program telemetry": (
        _rows(
            "time(millisecond),datetime(utc),latitude,longitude,height_above_takeoff(feet),speed(mph),"
            "compass_heading(degrees)",
            "{i}00,2023-05-01 12:00:0{i},32.2{i},-110.9{i},{even},5,{i}",
        ),
        _rows(
            "OSD.latitude,OSD.longitude,OSD.height [ft],GIMBAL.pitch,CUSTOM.date,timestamp",
            "32.2,-110.9,{even},-90,x,1683000000{i}00",
        ),
        "frame,latitude,longitude,altitude\n1,32.2,-110.9,50\n2,32.2,-110.9,51\n3,32.2,-110.9,52\n",
        "sep=;\n"
        + _rows(
            "CUSTOM.date [local];CUSTOM.updateTime [local];OSD.flyTime;OSD.latitude;OSD.longitude;OSD.height [ft];"
            "GIMBAL.pitch;CAMERA.isVideo",
            "26.08.2022;1:12:47,0{i} PM;0m 0,{i}s;41,6;-91,5;{even},5;-60,0;True",
        ),
        "# by a program\n"
        + _rows("Date,Time,GPS,Alt(m),Yaw(rad),fix_type", "8/26/2022,15:41:0{i}.9,48.1{i}N 11.5W,5{i},1.5,3"),
        "time\tlat\tlon\talt_ellipsoid\tundulation\tzoom\tfocal_len\ns\tdeg\tdeg\tft\tm\t\t\n"
        + _rows("0\t481\t115\t1\t1\t179\t24", "{i}00\t4810000{i}\t115000000\t{even}\t47\t1790\t240").replace("time", "t"),  # noqa: E501
    ),
    "subtitles": (
        _subtitles(
            '<font size="28">FrameCnt: {i}, DiffTime: 33ms\n2024-05-27 13:10:0{i}.033\n[fnum: 1.8] [focal_len: 24.00] '
            "[dzoom_ratio: 1.00], [latitude: 53.365080] [longitude: 6.460739] [rel_alt: 5.400 abs_alt: 44.744] "
            "[gb_yaw: -162.8 gb_pitch: -30.0 gb_roll: 1.0]</font>"
        ),
        _subtitles("HOME(-58.4,-34.7) 2017.07.03 10:15:0{i}\nGPS(-58.4,-34.7,19) BAROMETER:2{i}.1"),
        _subtitles("GPS(48.1,11.5,569.{i}) BAROMETER(9{i}.2) [Gimbal: Yaw:1.0, Pitch:-30.0] [Drone: Yaw:2.0]"),
        _subtitles(
            "SrtCnt : {i}\n2024-05-27 13:1{i}:00,033,060\n[latitude: 53.3{i}] [longitude: 6.4] [altitude: 35.4] "
            "[focal_len: 52.00] [dzoom_ratio: 17871, delta:0]"
        ).replace("000", "1824"),
        _subtitles(
            "F/2.8, SS 200, ISO 100, EV 0, GPS (8.5, 47.3, 19), D 24.5m, H {i}.0m, H.S 1.4m/s, V.S 0.1m/s, "
            "F.PRY (1.0°, -3.8°, 30.0°), G.PRY (-30.0°, 0.0°, 29.8°)"
        ),
    ),
    "nmea": (
        "\r\n".join(sentence(line.format(i=i)) for i in range(8) for line in _NMEA),
        "\n".join(line.format(i=i) for i in range(8) for line in (*_UNCHECKED, "$HETHS,274.0,A")),
        "\n".join(f"NMEA,{sentence(line.format(i=i))},149900000{i}" for i in range(8) for line in _NMEA),
    ),
    "classifier text": ("# weights\n" + "0.25 " * FEATURES + "\n-1.5\n", ",".join(["1e-3"] * FEATURES)),
    "seqinfo": ("[Sequence]\nname=x\nimDir=img1\nframeRate=30\nseqLength=5\nimWidth=640\nimHeight=480\nimExt=.jpg\n",),
    "record": (
        ('{"frames": {"read": 5, "written": 5}, "state": "complete", "outputs": ["masks", "tables"], '
        '"interval_frames": 2, "last_frame": 9, "versions": {"torchvision_dddas": "0.1.0"}}'),
    ),
    "studies": (
        ('name = "all"\ntasks = ["motion", "tracking"]\nconfig = "fast"\nset = ["track.birth_doubt=4"]\n'
        'backend = "onboard"\ninterval = 2\n[[dataset]]\nkind = "bms"\nfolder = "a"\nclips = ["bms_*"]\n'
        '[[dataset]]\nkind = "kitti"\nfolder = "../kitti"\nclasses = ["Car"]\n'),
    ),
    "addresses": ("8080", "0.0.0.0:8080", "[::1]:9000"),
    "streams": ("json:rows.jsonl", "mot:rows.txt", "json:/dev/null"),
    "input names": ("camera:0", "sim:four", "nowhere.mp4", "frames/frame[0-9].png", "sim:nowhere.toml", "x/", "sim:"),
    "other words": (
        *("camera:0", "camera:12", "rtsp://user:word@host/stream", "red=410,220,24,16", "a=b=1,2,3,4"),
        "frame1.png\nframe2.png\nframe10.png\n1a2b3.png\n000.png\n",
    ),
}  # fmt: skip


def text(kind: str) -> list[bytes]:
    return [content.encode() for content in TEXT[kind]]


def saved(name: str, *saves: Callable[[Path], object]) -> list[bytes]:
    """What is written into a file of the name by each."""
    contents = []
    for save in saves:
        with tempfile.TemporaryDirectory() as folder:
            save(Path(folder) / name)
            contents.append((Path(folder) / name).read_bytes())
    return contents


@cache
def mavlink() -> list[bytes]:
    said = eastward(10)
    angles = {"roll": 0, "pitch": -30, "yaw": 5}
    turns = [(row[0], "MOUNT_ORIENTATION", {"time_boot_ms": 5000 + 125 * k, **angles}) for k, row in enumerate(said)]
    others = tlog(said[:6], system=255, component=190) + tlog(turns[:6], component=154)
    return [tlog(said, version=1), tlog(sorted(said + turns, key=lambda row: row[0]), version=2) + others]


@cache
def px4() -> list[bytes]:
    place = ["double lat", "double lon", "float alt"]
    local = ["float x", "float y", "float z", "float vx", "float vy", "bool z_valid", "bool v_xy_valid"]
    topics: dict = {
        "vehicle_global_position": (place, [(100_000 * i, 32.2, -110.9 + 1e-5 * i, 800 + i) for i in range(12)]),
        "vehicle_local_position": (local, [(100_000 * i, i, 0, -50, 1, 0, 1, 1) for i in range(12)]),
        "vehicle_attitude": (["float[4] q"], [(100_000 * i, 1, 0, 0, 0) for i in range(12)]),
    }
    receiver = ["double latitude_deg", "double longitude_deg", "double altitude_msl_m", "uint8_t fix_type"]
    fixes = {f"sensor_gps {k}": (receiver, [(100_000 * i, 32.2, -110.9, 800, 3 * k) for i in range(6)]) for k in (0, 1)}
    return [ulog(topics), ulog(fixes)]


_KINDS = {
    "GPS": ("QBBIHBcLLffffB", "TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd,GCrs,VZ,U"),
    "POS": ("QLLfff", "TimeUS,Lat,Lng,Alt,RelHomeAlt,RelOriginAlt"),
    "ATT": ("QcC", "TimeUS,Roll,Yaw"),
    "MNT": ("QBfffff", "TimeUS,I,Roll,Pitch,YawB,YawE,Dist"),
}


@cache
def ardupilot(as_text: bool) -> list[bytes]:
    rows: list[tuple] = []
    for i in range(8):
        us, clock, place = 1_000_000 + 200_000 * i, (200 * i, 2300, 9, 0.9), (32.2, -110.9 + 1e-5 * i, 800.0)
        rows += [("GPS", us, k, 3 * k, *clock, *place, 5.0, 90.0, 0.0, 1) for k in (0, 1)]
        rows += [("POS", us, *place, 50.0, 51.0), ("ATT", us, 0, 90), ("MNT", us, 0, 0.0, -30.0, 5.0, 95.0, 0.0)]
    return [dataflash_text(_KINDS, rows).encode()] if as_text else [dataflash(_KINDS, rows)]


@cache
def klv(in_stream: bool) -> list[bytes]:
    view = {16: spread(60, 0, 180, 2), 25: spread(300, -900, 19000, 2)}
    packets = [packet(i, {**attitude(159.97, -0.43, 3.4, 100, -30, 0), **view}) for i in range(6)]
    times = [3600 * i for i in range(6)]
    others = [one[:-2] + b"\0\0" for one in packets]
    if in_stream:
        return [transport_stream(times, list(zip(times, some, strict=True))) for some in (packets, others)]
    return [b"".join(packets), b"\0lead" + b"".join(others)]


@cache
def classifiers(suffix: str) -> list[bytes]:
    weights = np.linspace(-1, 1, FEATURES + 1, dtype=np.float32)
    if suffix == ".npy":
        return saved("a.npy", lambda path: np.save(path, weights))
    if suffix == ".npz":
        return saved("a.npz", lambda path: np.savez(path, weights=weights[1:], bias=np.float32(1), bins=9, cell=8))
    descriptor, svm = cv2.HOGDescriptor(), cv2.ml.SVM.create()
    descriptor.setSVMDetector(np.array(cv2.HOGDescriptor.getDefaultPeopleDetector()))
    svm.setKernel(cv2.ml.SVM_LINEAR)
    rows = np.array([[k, 1 - k, 0.5] for k in (0, 1, 0.1, 0.9)], np.float32)
    svm.train(rows, cv2.ml.ROW_SAMPLE, np.array([0, 1, 0, 1], np.int32))
    return saved(f"a{suffix}", lambda path: descriptor.save(str(path)), lambda path: svm.save(str(path)))


@cache
def pictures(suffix: str, deep: bool = False) -> list[bytes]:
    image = np.full((24, 32, 3), 90, np.uint8)
    image[6:14, 8:20] = (200, 160, 120)
    grey = np.ascontiguousarray(image[..., 0])
    kinds: list[np.ndarray] = [
        image,
        *([grey] if suffix != ".ppm" else []),
        *([grey.astype(np.uint16) * 250] if deep else []),
    ]
    return [cv2.imencode(suffix, kind)[1].tobytes() for kind in kinds]


@cache
def videos(suffix: str, codec: str) -> list[bytes]:
    if codec == "libx264":
        return saved(f"a{suffix}", lambda path: write_by_av(path, codec, list(range(0, 800, 100)), g="4"))
    return saved(f"a{suffix}", lambda path: write_video(path, codec, frames=8))


@cache
def raster(bands: int) -> list[bytes]:
    """A GeoTIFF in local metres of 16 x 16 cells about 0, 0."""
    import rasterio

    values = np.arange(256, dtype=np.float32 if bands == 1 else np.uint8).reshape(16, 16)
    shape = {"height": 16, "width": 16, "count": bands, "dtype": str(values.dtype)}
    corner = rasterio.transform.from_origin(-80, 80, 10, 10)
    with rasterio.MemoryFile() as memory:
        with memory.open(driver="GTiff", crs="EPSG:32612", transform=corner, **shape) as file:
            file.write(np.repeat(values[None], bands, axis=0))
        return [bytes(memory.read())]


@cache
def data_set(kind: str, clip: str) -> Mapping[str, bytes]:
    """The files of a data set of one clip, by their paths in it."""
    with tempfile.TemporaryDirectory() as folder:
        MAKE[kind](Path(folder), clip)
        files = [path for path in sorted(Path(folder).rglob("*")) if path.is_file()]
        return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}
