"""Estimate how much larger the errors of landmarks are than stated, and widen the ellipses accordingly.

Telemetry, places and pixels are fitted together. The landmarks' corrections and residuals, in stated standard
deviations, have a sum of squares A, whose expected value is their redundancy R: the number of measurements beyond those
that the pose needs. If A is larger than chance allows, the landmarks' variances are multiplied by A / R. That factor is
uncertain too, so the ellipse follows Student's t distribution. Source: estimation of variance components (W.
Förstner, 1979).
"""

from dataclasses import dataclass, replace

import numpy as np

from torchvision_dddas.geo.pose_estimation import EXACT_M, PoseSolution
from torchvision_dddas.types import Bool, LandmarkObservations

# A misfit counts if its probability by chance is below this: in a single frame, where it affects only that frame, and
# over frames, where it is tested in every frame and affects all later frames.
IN_A_FRAME, OVER_FRAMES = 0.05, 0.005


@dataclass(frozen=True)
class Misfit:
    """Evidence on the landmarks' errors: the sum of squares, in stated sigmas, and the redundancy."""

    squares: float = 0.0
    redundancy: float = 0.0

    def and_more(self, seen: "Misfit", share: float) -> "Misfit":
        """Add a share of another frame's misfit: frames with the same errors add no information."""
        return Misfit(self.squares + share * seen.squares, self.redundancy + share * seen.redundancy)

    def factor(self, chance: float) -> float:
        """Return the factor by which to multiply the stated standard deviations of the landmarks, at least 1."""
        from scipy.special import chdtrc  # imported here because only landmarks need these 25 MB

        if self.redundancy < 1 or chdtrc(self.redundancy, self.squares) > chance:
            return 1.0
        return float(np.sqrt(self.squares / self.redundancy))


def student_factor(freedom: float) -> float:
    """Return the factor on an estimated variance with which a 95 % ellipse holds 95 % of the true places.

    It is the quantile of F with 2 and `freedom` degrees of freedom over the quantile of chi-square with 2.
    """
    return freedom * (20 ** (2 / freedom) - 1) / (2 * float(np.log(20)))


def measure_misfit(solution: PoseSolution, marks: LandmarkObservations, used: Bool[np.ndarray, "n"]) -> Misfit:
    """Measure the misfit of the landmarks of a frame's solution, in units of their stated standard deviations."""
    weight = 1 / np.repeat(np.maximum(marks.sigma_m, EXACT_M), 2) ** 2
    seen = 1 / np.repeat(marks.pixel_sigma[used], 2) ** 2
    squares = weight @ solution.correction[7:] ** 2 + seen @ solution.missing**2
    by_place = 2 * len(marks) - weight @ np.diag(solution.correction_covariance)[7:]
    taken = (solution.slopes * np.linalg.solve(solution.curvature, solution.slopes.T).T).sum(axis=1)
    by_pixel = len(seen) - seen @ taken
    return Misfit(float(squares), float(by_place + by_pixel))


def widen_errors(marks: LandmarkObservations, factor: float) -> LandmarkObservations:
    """Return the landmarks with the standard deviations of places and pixels multiplied by a factor."""
    return replace(marks, sigma_m=marks.sigma_m * factor, pixel_sigma=marks.pixel_sigma * factor)
