"""Small clips whose truth is known, one maker for each family of parameters."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from tests.overflight import ORIGIN, Overflight
from tests.synthetic_clip import film_into
from torchvision_dddas.geometry import lonlat
from torchvision_dddas.lab.evaluation.datasets.kinds import read
from torchvision_dddas.lab.evaluation.datasets.record import Clip, Source
from torchvision_dddas.lab.evaluation.metrics import truth as truths
from torchvision_dddas.lab.evaluation.metrics.truth import Positions, TrackTable, Truth
from torchvision_dddas.types import Camera

PERSON = np.array([20.0, 50.0])
CAMERA = Camera(
    "ground", (1280, 720), (1000.0, 1000.0), (639.5, 359.5), height_m=1.6, focal_sigma=0.001, height_sigma_m=0.01,
    pitch_sigma_rad=1e-4, heading_sigma_rad=1e-4, position_sigma_m=0.01,
)  # fmt: skip


def filmed_clip(place: Path, frames: int) -> Clip:
    """Pictures of 240 x 180 with masks of what moves."""
    film_into(place / "film", 3, frames, (240, 180))
    (found,) = read(Source("folder", place), place).clips
    return found


def walk(name: str = "walk", people: int = 4, frames: int = 150, seed: int = 0, true: bool = True) -> Clip:
    """People who walk about for a while."""
    draw = np.random.default_rng(seed)
    place = draw.uniform(100, 400, (people, 2)) + np.cumsum(draw.normal(0, 0.5, (frames, people, 2)), axis=0).cumsum(0)
    frame = np.repeat(np.arange(1, frames + 1), people)
    identity = np.tile(np.arange(1, people + 1), frames)
    box_px = np.concatenate([place.reshape(-1, 2) - PERSON / 2, np.tile(PERSON, (len(frame), 1))], axis=1)
    table = TrackTable(frame, identity, box_px)
    truth = Truth("boxes", Path(name), {}, {int(f): box_px[frame == f] for f in np.unique(frame)}, table)
    return Clip(name, Path(name), truth=truth if true else None)


def seen(clip: Clip, place: Path, false: int = 1, miss: float = 0.1, seed: int = 1) -> Clip:
    """The clip with public detections: some people missed, boxes that scatter, and false alarms in each frame."""
    draw = np.random.default_rng(seed)
    assert clip.truth is not None
    lines = []
    for frame, boxes in clip.truth.boxes.items():
        for x, y, width, height in boxes[draw.uniform(size=len(boxes)) >= miss] + draw.normal(0, 0.5, (1, 4)):
            lines.append(f"{frame},-1,{x:.2f},{y:.2f},{width:.2f},{height:.2f},{draw.choice([0.8, 0.99, 1.0])}")
        for x, y in draw.uniform(-200, 700, (false, 2)):
            lines.append(f"{frame},-1,{x:.2f},{y:.2f},20,50,{draw.choice([0.8, 0.99])}")
    path = place / f"{clip.name}.txt"
    path.write_text("\n".join(lines) + "\n")
    return replace(clip, given=path)


def flown(folder: Path, flight: Overflight, sigma: bool = True) -> Clip:
    """The clip of a flight, by tables alone. sigma: whether landmarks say how well they are known."""
    table = flight.landmarks_csv()
    if not sigma:
        table = "\n".join(line.rpartition(",")[0] for line in table.splitlines()) + "\n"
    for name, text in (
        ("landmarks.csv", table),
        ("telemetry.csv", flight.telemetry_csv()),
        ("camera.toml", flight.camera_toml()),
        ("gt.txt", flight.tracks_txt()),
        ("det.txt", flight.tracks_txt(identities=False)),
    ):
        (folder / name).write_text(text)
    where = np.concatenate([flight.targets(frame) for frame in flight.numbers()])
    frames, who = np.repeat(list(flight.numbers()), 4), np.tile(np.arange(1, 5), flight.frames)
    places = Positions(frames, who, where, lonlat(where, ORIGIN) if flight.geographic else None)
    truth = replace(truths.load_truth(folder / "gt.txt"), positions=places)
    return Clip(
        "flown",
        folder,
        rate_hz=10.0,
        truth=truth,
        given=folder / "det.txt",
        telemetry=folder / "telemetry.csv",
        landmarks=folder / "landmarks.csv",
        camera=folder / "camera.toml",
    )


def ground_people(seed: int, count: int = 12, feet: float = 0.03, tall: float = 0.05, body: float = 0.1):
    """Boxes of people ahead of a level camera, with errors of foot rows and heights, and where they stand."""
    rng = np.random.default_rng(seed)
    ahead, aside = rng.uniform(6, 20, count), rng.uniform(-3, 3, count)
    height = 1.75 + body * rng.normal(0, 1, count)
    feet_px, head_px = (359.5 + 1000 * (1.6 - up) / ahead for up in (0 * height, height))
    size = feet_px - head_px
    foot = feet_px + feet * size * rng.normal(0, 1, count)
    size = size * (1 + tall * rng.normal(0, 1, count))
    u = 639.5 + 1000 * aside / ahead + feet * size * rng.normal(0, 1, count)
    box = np.stack([u + 0.5 - size / 5, foot + 0.5 - size, 0.4 * size, size], axis=1)
    return box, np.stack([aside, ahead], axis=1)


def ground_clip(folder: Path) -> Clip:
    """A clip of two pictures, with detections that are exact but for a box of nobody, and a camera."""
    rows, found = [], []
    for frame in (1, 2):
        box, _ = ground_people(frame, 5, 0, 0, 0)
        for who, (x, y, w, h) in enumerate(box.tolist(), 1):
            rows.append(f"{frame},{who},{x:.3f},{y:.3f},{w:.3f},{h:.3f},1,-1,-1,-1\n")
            found.append(f"{frame},-1,{x:.3f},{y:.3f},{w:.3f},{h:.3f},1,-1,-1,-1\n")
        found.append(f"{frame},-1,20,20,30,60,1,-1,-1,-1\n")
    (folder / "gt.txt").write_text("".join(rows))
    (folder / "det.txt").write_text("".join(found))
    (folder / "camera.toml").write_text(
        "focal_px = 1000\nwidth_px = 1280\nheight_px = 720\nheight_m = 1.6\neast_m = 0\nnorth_m = 0\nheading_deg = 0\n"
    )
    numbers = np.repeat([1, 2], 5), np.tile(np.arange(1, 6), 2)
    where = Positions(*numbers, np.concatenate([ground_people(frame, 5, 0, 0, 0)[1] for frame in (1, 2)]))
    truth = replace(truths.load_truth(folder / "gt.txt"), positions=where)
    return Clip("ground", folder, truth=truth, given=folder / "det.txt", camera=folder / "camera.toml")
