"""What a team of ground vehicles gains: mean error of one, of equal averages, and of fusing by covariances.

    python eval/fusion_error.py [--scenes 200]

Simulated: vehicles in a ring about a crowd, 15 m off, each with a GPS of 3.5 m in 95 %, a compass of 2° and boxes as
noisy as the defaults say. Who is who is given for the errors, and counted apart: `wrong` are sightings that `associate`
puts to another person than most of their group. No data are needed.
"""

import argparse
from dataclasses import replace

import numpy as np

from torchvision_dddas.config import GroundParameters
from torchvision_dddas.geo.fusion import associate, estimate_places
from torchvision_dddas.geo.ranging import range_people
from torchvision_dddas.types import Camera, Poses, Sightings

KNOBS = GroundParameters()
RING_M = 15.0


def look(people: np.ndarray, tall: np.ndarray, turn: float, rng: np.random.Generator) -> Sightings:
    """What the vehicle at that side of the crowd sees, with errors drawn from all that its camera says of itself."""
    place, n = RING_M * np.array([np.sin(turn), np.cos(turn)]), len(people)
    known = Camera("", (4000, 2000), (1000.0, 1000.0), (1999.5, 999.5), heading_rad=turn + np.pi, height_m=1.2)
    true = replace(
        known,
        place=tuple(place + rng.normal(0, known.position_sigma_m, 2)),
        heading_rad=known.heading_rad + rng.normal(0, known.heading_sigma_rad),
        pitch_rad=rng.normal(0, known.pitch_sigma_rad),
        height_m=known.height_m + rng.normal(0, known.height_sigma_m),
        focal_px=(known.focal_px[0] * (1 + rng.normal(0, known.focal_sigma)),) * 2,
    )
    away = people - true.place
    ahead = away @ [np.sin(true.heading_rad), np.cos(true.heading_rad)]
    aside = away @ [np.cos(true.heading_rad), -np.sin(true.heading_rad)]

    def row(down: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        depth = ahead * np.cos(true.pitch_rad) + down * np.sin(true.pitch_rad)
        y = (down * np.cos(true.pitch_rad) - ahead * np.sin(true.pitch_rad)) / depth
        return aside / depth * true.focal_px[0] + 1999.5, y * true.focal_px[1] + 999.5

    (u, feet), (_, head) = row(np.full(n, true.height_m)), row(true.height_m - tall)
    height = feet - head
    moved = [rng.normal(0, np.hypot(s * height, 0.5)) for s in (KNOBS.feet_sigma, KNOBS.feet_sigma, KNOBS.height_sigma)]
    u, feet, height = u + moved[0], feet + moved[1], height + moved[2]
    box = np.stack([u + 0.5 - 0.2 * height, feet + 0.5 - height, 0.4 * height, height], axis=1)
    poses = Poses(np.tile(place, (n, 1)), np.full(n, known.heading_rad), np.zeros(n))
    return range_people(box, np.zeros(n, bool), known, poses, poses.place, KNOBS)


def scene(vehicles: int, people: int, rng: np.random.Generator) -> tuple[list[float], ...]:
    """Errors of one vehicle, of equal averages and of fusing; whether each ellipse holds; shares that are wrong."""
    where, tall = rng.normal(0, 4, (people, 2)), KNOBS.body_height_m + rng.normal(0, KNOBS.body_height_sigma_m, people)
    team = [look(where, tall, 2 * np.pi * v / vehicles + rng.normal(0, 0.3), rng) for v in range(vehicles)]
    team = [seen for seen in team if (seen.by != "bearing").all()]
    fused, joint, _ = estimate_places(team, np.tile(np.arange(people)[:, None], len(team)))
    own, off = joint[np.arange(people), :, np.arange(people)], fused - where
    inside = np.einsum("ni,nij,nj->n", off, np.linalg.inv(own), off) < 5.991
    groups = [row[row >= 0] for row in associate(team)]
    return (
        np.concatenate([np.linalg.norm(seen.east_north_m - where, axis=1) for seen in team]).tolist(),
        np.linalg.norm(np.mean([seen.east_north_m for seen in team], axis=0) - where, axis=1).tolist(),
        np.linalg.norm(off, axis=1).tolist(),
        inside.tolist(),
        [sum(len(g) - np.bincount(g).max() for g in groups) / sum(len(g) for g in groups)],
    )


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=200)
    options = parser.parse_args()
    print("| vehicles | people | alone, m | averaged, m | fused, m | in the 95 % ellipse | wrong |")
    print("| ---: | ---: | ---: | ---: | ---: | ---: | ---: |")
    for vehicles, people in ((2, 1), (4, 1), (2, 6), (4, 3), (4, 6), (4, 12)):
        rng = np.random.default_rng(7)
        found = zip(*(scene(vehicles, people, rng) for _ in range(options.scenes)), strict=True)
        alone, equal, fused, inside, wrong = (float(np.mean([v for part in parts for v in part])) for parts in found)
        print(
            f"| {vehicles} | {people} | {alone:.2f} | {equal:.2f} | {fused:.2f} | {100 * inside:.1f} % "
            f"| {100 * wrong:.1f} % |"
        )


if __name__ == "__main__":
    main()
