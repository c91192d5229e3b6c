"""Measure errors of targets located from the air beside the Cramér-Rao bound, by altitude, pitch and errors.

python eval/position_bound.py

The study needs no data. It simulates single pictures (geo_scene.py, seed 0): 1080p, a lens of 70 degrees, 1 px, targets
within 25 m of the middle of the view. Errors of telemetry and receivers are 0.2, 1 and 2 times those of a consumer
drone: 1 % in focal length, 1 degree in tilt, 5 in heading, 2 % in altitude, 3.5 m of GPS in 95 %. The stated errors are
right. The bound holds for unbiased estimates and counts the priors as measurements.
"""

from dataclasses import dataclass
from typing import Any

import bench
import geo_error
import geo_scene
import numpy as np

from torchvision_dddas.config import Settings, with_parameters
from torchvision_dddas.geo.georeferencer import Georeferencer
from torchvision_dddas.geo.plane_homography import load_solver, locate_pixels

GRADES = {"a fifth": 0.2, "consumer": 1.0, "twice": 2.0}
PARAMETERS = ("tilt_sigma_deg", "heading_sigma_deg", "position_sigma_m", "altitude_sigma", "focal_sigma")
TARGETS = 20


@dataclass(frozen=True)
class Errors:
    """RMS error of the targets and of the bound, metres, and the share within 95 % ellipses."""

    rms_m: float
    bound_m: float
    inside: float


def measure(case: geo_scene.Case, count: int) -> Errors:
    """Locate the targets of some scenes, each picture separately."""
    plain = geo_error.settings_for("pose")
    stated = {f"aerial.{name}": case.grade * getattr(plain.aerial, name) for name in PARAMETERS}
    settings: Settings = with_parameters(plain, stated)
    batch, solver, off, inside = geo_scene.scenes(case, count, TARGETS), load_solver("onboard"), [], []
    for s, (flight, marks) in enumerate(geo_error.georeferencer_inputs(batch)):
        fix = Georeferencer(geo_scene.CAMERA, settings, solver).update(1, 0.0, flight, marks)
        place, covariance = locate_pixels(fix, geo_scene.CAMERA, batch.targets_px[s], case.pixel_sigma)
        off.append(place - batch.true_targets[s])
        inside.append(geo_error.inside_ellipses(off[-1], covariance))
    squares = (np.concatenate(off) ** 2).sum(axis=1)
    bound = np.trace(geo_scene.pose_bound(batch), axis1=-2, axis2=-1)
    return Errors(float(np.sqrt(np.nanmean(squares))), float(np.sqrt(bound.mean())), float(np.nanmean(inside)))


def measure_bounds(options: bench.Options) -> tuple[str, Any]:
    """Measure errors for each altitude, pitch and grade of errors, by telemetry alone and with landmarks."""
    rows = []
    for altitude in options.altitudes:
        for pitch in options.pitches:
            for name, grade in GRADES.items():
                row: list[object] = [f"{altitude:.0f}", f"{pitch:.0f}°", name]
                for landmarks in (0, options.landmarks):
                    case = geo_scene.Case(altitude, landmarks, tilt_deg=90 - pitch, grade=grade)
                    found = measure(case, options.scenes)
                    row += [f"{found.rms_m:.2f} ({found.bound_m:.2f})", f"{found.rms_m / found.bound_m:.2f}"]
                    row.append(f"{100 * found.inside:.0f} %")
                rows.append(row)
                bench.log(*row)
    each = ("rms m (bound)", "ratio", "in 95 %")
    head = [f"{by}: {what}" for by in ("telemetry", f"{options.landmarks} landmarks") for what in each]
    return bench.format_table(["AGL m", "pitch", "errors", *head], rows, words=3), rows


if __name__ == "__main__":
    altitudes, pitches = [50.0, 100.0, 200.0], [90.0, 70.0, 50.0, 30.0]
    options = {"--altitudes": altitudes, "--pitches": pitches, "--landmarks": 4, "--scenes": 200}
    bench.main(__doc__, {"": (measure_bounds, options)})
