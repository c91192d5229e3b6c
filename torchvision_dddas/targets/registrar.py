"""How the pictures of a clip lie on the ground, frame by frame."""

from dataclasses import replace

import numpy as np

from torchvision_dddas.settings import Settings
from torchvision_dddas.targets.first_pose import find_pose
from torchvision_dddas.targets.plane import Solver, homography_fix, too_few
from torchvision_dddas.targets.pose import bare_prior, expected_of, prior_of
from torchvision_dddas.types import Camera, Fix, Flight, Marks


class Registrar:
    """Lays the frames of one clip on the ground; told of them in order."""

    def __init__(
        self,
        camera: Camera,
        settings: Settings,
        solver: Solver,
        focal_known: bool = True,
        names: tuple[str, ...] = (),
        ground_up_m: float = 0.0,
    ) -> None:
        self.camera, self.settings, self.solver = camera, settings, solver
        self.focal_known, self.names, self.ground_up_m = focal_known, names, ground_up_m

    def step(
        self,
        frame: int,
        time_s: float,
        flight: Flight | None,
        marks: Marks,
        degrees: tuple[np.ndarray, tuple[float, float]] | None = None,
    ) -> Fix:
        """How one frame lies on the ground.

        flight: what telemetry says then, its place in local metres; None without telemetry. marks: the landmarks,
        places in local metres. degrees, for aerial.mode = paper: longitudes and latitudes of the marks (n, 2) and the
        origin of the local metres.
        """
        knobs = self.settings.aerial
        usable = np.isfinite(marks.image_px).all(axis=1) & np.isfinite(marks.east_north_m).all(axis=1)
        marks = _rows(marks, usable)
        if knobs.mode != "pose":
            degrees = None if degrees is None else (np.asarray(degrees[0])[usable], degrees[1])
            return homography_fix(frame, marks, self.solver, knobs.least_spread, degrees, paper=knobs.mode == "paper")
        prior = prior_of(flight, self.camera, knobs, self.ground_up_m, self.focal_known)
        n = len(marks)
        if prior is None:
            if n < 4:
                return Fix(frame, "", landmark=marks.landmark, state=("excluded",) * n, cause=too_few(frame, n))
            prior = bare_prior(self.camera, knobs, self.focal_known)
        solution = find_pose(marks, self.camera, expected_of(prior, marks.sigma_m))
        if solution is None:
            cause = f"no pose of the camera shows the landmarks of frame {frame} where the picture has them"
            return Fix(frame, "", landmark=marks.landmark, state=("excluded",) * n, cause=cause)
        return Fix(
            frame,
            "pose" if n else "telemetry",
            solution.pose,
            solution.covariance[:7, :7],
            landmark=marks.landmark,
            state=("used",) * n,
            chi2=solution.cost,
            freedom=solution.freedom,
        )


def _rows(marks: Marks, which: np.ndarray) -> Marks:
    return replace(marks, **{name: getattr(marks, name)[which] for name in marks.__dataclass_fields__})
