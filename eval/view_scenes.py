"""Pairs of views with known identities: streets, crowds and real tracks, seen by two cameras that move and turn.

A target is a cuboid on a plane. Its box in a picture encloses its corners, clipped at the border, with noise. Targets
are missed for some frames at a time. Each view has its own numbers, with new numbers after gaps and at random.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from torchvision_dddas import geometry

SIZE, RATE_HZ = (1920, 1080), 10.0
CAR, VAN, PERSON, BIKER = (4.5, 1.8, 1.5), (6.5, 2.2, 2.6), (0.5, 0.5, 1.7), (1.7, 0.6, 1.7)
PIXEL_M, CUT_PX = 0.045, 8


class View(NamedTuple):
    """A picture: true numbers (N,) and own numbers (N,) of the targets, boxes (N, 4), the picture's map (3, 3)."""

    true: np.ndarray
    own: np.ndarray
    box_px: np.ndarray
    picture_from_ground: np.ndarray


class World(NamedTuple):
    """Places (T, N, 2) in metres, NaN while away, directions (T, N) and length, width, height (N, 3)."""

    place: np.ndarray
    turn: np.ndarray
    size_m: np.ndarray


def street_world(rng: np.random.Generator, frames: int) -> World:
    """Draw a crossing of two streets with four lanes, regularly spaced queues, rows of parked cars, and walkers."""
    tracks: list[tuple[np.ndarray, np.ndarray, tuple[float, float, float]]] = []
    time = np.arange(frames) / RATE_HZ
    for street in range(2):
        angle = street * np.pi / 2 + rng.normal(0, 0.15)
        along, across = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
        for lane, offset in enumerate((-5.2, -1.8, 1.8, 5.2)):
            sign, gap = 1 if lane < 2 else -1, rng.uniform(7, 22)
            speed = rng.uniform(4, 12) * (np.sin(2 * np.pi * time / rng.uniform(15, 40) + rng.uniform(0, 6)) > -0.3)
            run = np.cumsum(np.convolve(np.pad(speed, (10, 10), "edge"), np.ones(21) / 21, "valid")) / RATE_HZ
            for car in np.arange(-130 - run[-1], 130, gap):
                s = car + rng.normal(0, 0.12) * gap + run * (1 + rng.normal(0, 0.01))
                s = np.where(abs(s) < 130, s, np.nan)
                way = sign * s[:, None] * along + offset * across
                tracks.append((way, np.full(frames, angle), VAN if rng.random() < 0.15 else CAR))
        for side in (-9.0, 9.0):
            for place in np.arange(-100, 100, 6.0):
                if abs(place) > 14 and rng.random() < 0.5:
                    where = place * along + side * across + rng.normal(0, 0.2, 2)
                    tracks.append((np.tile(where, (frames, 1)), np.full(frames, angle), CAR))
            for _ in range(rng.integers(3, 10)):
                s = rng.uniform(-80, 80) + rng.choice([-1, 1]) * rng.uniform(0.8, 1.8) * time
                way = s[:, None] * along + (side * 1.4 + rng.normal(0, 0.7)) * across
                tracks.append((way, np.full(frames, angle), PERSON))
    return _join(tracks)


def crowd_world(rng: np.random.Generator, frames: int) -> World:
    """Draw walkers and bikers on a square, some in groups, some standing."""
    tracks = []
    for _ in range(rng.integers(12, 35)):
        start, angle = rng.uniform(-35, 35, 2), rng.uniform(0, 2 * np.pi)
        is_biker = rng.random() < 0.2
        speed = rng.uniform(3, 5) if is_biker else 0.0 if rng.random() < 0.25 else rng.uniform(0.7, 1.7)
        bend = angle + np.cumsum(rng.normal(0, 0.03, frames))
        way = start + np.cumsum(np.c_[np.cos(bend), np.sin(bend)] * speed / RATE_HZ, axis=0)
        group = 1 if is_biker else rng.integers(1, 4)
        tracks += [(way + rng.normal(0, 0.9, 2), bend, BIKER if is_biker else PERSON) for _ in range(group)]
    return _join(tracks)


def real_world(file: Path, frames: int, first: int) -> World:
    """Read real tracks of the Stanford Drone Dataset, seen from straight above, at every third frame."""
    rows = [line.split() for line in file.read_text().splitlines()]
    tracks = []
    for number in sorted({row[0] for row in rows}):
        own = [row for row in rows if row[0] == number and row[6] == "0"]
        box, at = np.array([row[1:5] for row in own], float).reshape(-1, 4), np.array([int(row[5]) for row in own])
        way = np.full((frames, 2), np.nan)
        middle = (box[:, :2] + box[:, 2:]) / 2 * PIXEL_M
        index, is_used = (at - first) // 3, ((at - first) % 3 == 0) & (at >= first) & (at < first + 3 * frames)
        way[index[is_used]] = middle[is_used]
        if is_used.any():
            kind = own[0][9].strip('"')
            size = {"Pedestrian": PERSON, "Biker": BIKER, "Skater": PERSON, "Bus": (11.0, 2.5, 3.0)}.get(kind, CAR)
            step = np.nan_to_num(np.gradient(way, axis=0))
            tracks.append((way, np.arctan2(step[:, 1], step[:, 0]), size))
    world = _join(tracks)
    return world._replace(place=world.place - np.nanmedian(world.place, axis=(0, 1)))


def _join(tracks: list) -> World:
    ways, turns, sizes = zip(*tracks, strict=True)
    return World(np.stack(ways, 1), np.stack(turns, 1), np.array(sizes))


def fly(rng: np.random.Generator, frames: int, height_m: tuple[float, float], heading: float, aim: np.ndarray) -> list:
    """Return picture_from_ground (3, 3) and cameras (3, 4) of a flight that drifts and turns."""
    pitch, height = np.radians(rng.uniform(30, 65)), rng.uniform(*height_m)
    drift, spin = rng.normal(0, 0.7, 3) * (1, 1, 0.2), np.radians(rng.normal(0, 1.0))
    focal = SIZE[0] * rng.uniform(0.62, 0.9)
    sway = rng.normal(0, 1, (frames, 3)) * np.radians(0.4)
    sway = np.stack([np.convolve(np.pad(s, 10, "edge"), np.hanning(21) / 4, "valid") for s in sway.T], 1)
    cameras = []
    for k in range(frames):
        t = k / RATE_HZ
        yaw, tilt = heading + spin * t + sway[k, 0], pitch + sway[k, 1] / 2
        forward = np.array([np.cos(yaw) * np.cos(tilt), np.sin(yaw) * np.cos(tilt), -np.sin(tilt)])
        right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
        start = np.array([*aim, 0.0]) - height / np.tan(pitch) * np.array([np.cos(heading), np.sin(heading), 0])
        centre = start + [0, 0, height] + drift * t
        rotation = np.stack([right, np.cross(forward, right), forward])
        intrinsic = np.array([[focal, 0, (SIZE[0] - 1) / 2], [0, focal, (SIZE[1] - 1) / 2], [0, 0, 1]])
        cameras.append(intrinsic @ np.c_[rotation, -rotation @ centre])
    return cameras


def film(rng: np.random.Generator, world: World, cameras: list) -> Iterator[View]:
    """Yield a tracker's view of the world in each frame of a camera."""
    count = world.place.shape[1]
    numbers = rng.permutation(20 * count)[:count].tolist()
    fresh = iter(range(20 * count, 10**9))
    is_missed, gone = np.zeros(count, bool), np.zeros(count, int)
    signs = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (0, 1)])
    for k, camera in enumerate(cameras):
        body = signs * world.size_m[:, None]
        cos, sin = np.cos(world.turn[k])[:, None], np.sin(world.turn[k])[:, None]
        corner = np.stack([cos * body[..., 0] - sin * body[..., 1], sin * body[..., 0] + cos * body[..., 1]], -1)
        corner = np.concatenate([corner + world.place[k][:, None], body[..., 2:]], -1)
        seen = np.concatenate([corner, np.ones((*corner.shape[:2], 1))], -1) @ camera.T
        pixel = seen[..., :2] / np.maximum(seen[..., 2:], 1e-6)
        low, high = pixel.min(1), pixel.max(1)
        whole = (high - low).prod(1)
        noise = rng.normal(0, 0.04, (2, count, 2)) * np.nan_to_num(np.sqrt(np.maximum(whole, 0)))[:, None]
        low, high = np.clip(low + noise[0], 0, SIZE), np.clip(high + noise[1], 0, SIZE)
        with np.errstate(invalid="ignore"):
            is_there = np.isfinite(whole) & (seen[..., 2] > 1).all(1) & ((high - low).prod(1) > 0.4 * whole)
        is_there &= (high - low).min(1) >= CUT_PX
        is_missed = np.where(is_missed, rng.random(count) > 0.2, rng.random(count) < 0.02)
        is_there &= ~is_missed
        gone = np.where(is_there, 0, gone + 1)
        for i in np.flatnonzero((gone == 12) | (rng.random(count) < 0.001)).tolist():
            numbers[i] = next(fresh)
        rows = np.flatnonzero(is_there)
        box = np.concatenate([low, high - low], 1)[rows]
        yield View(rows, np.array(numbers)[rows] + 1, box, camera[:, [0, 1, 3]])


def scene(kind: str, seed: int, frames: int = 300) -> tuple[list[View], list[View]]:
    """Return a pair of views. kind: street, crowd, or the path of a table of real tracks."""
    rng = np.random.default_rng([seed, len(kind)])
    heights = (45.0, 110.0) if kind == "street" else (18.0, 50.0)
    if kind == "street":
        world = street_world(rng, frames)
    elif kind == "crowd":
        world = crowd_world(rng, frames)
    else:
        world = real_world(Path(kind), 140, seed % 30)
        frames = 140
    heading, spread = rng.uniform(0, 2 * np.pi), heights[0] / 4
    views = []
    for turn in (0.0, rng.uniform(-np.pi, np.pi)):
        cameras = fly(rng, frames, heights, heading + turn, rng.normal(0, spread, 2))
        views.append(list(film(rng, world, cameras)))
    return views[0], views[1]


def true_map(a: View, b: View) -> np.ndarray:
    """Return the homography (3, 3) from the picture of a to the picture of b, over the ground."""
    return b.picture_from_ground @ np.linalg.inv(a.picture_from_ground)


def feet(box_px: np.ndarray) -> np.ndarray:
    """Return the middles (N, 2) of the lower edges."""
    return box_px[:, :2] + box_px[:, 2:] * (0.5, 1.0) - (0.5, 1.0)


def nearest_right(a: View, b: View) -> tuple[int, int]:
    """Count targets in both views whose nearest foot point by the true map is their own, and all targets in both."""
    there = geometry.transfer(true_map(a, b), feet(a.box_px))
    apart = np.linalg.norm(there[:, None] - feet(b.box_px)[None], axis=-1)
    both = np.isin(a.true, b.true)
    return int((b.true[apart[both].argmin(1)] == a.true[both]).sum()) if both.any() else 0, int(both.sum())
