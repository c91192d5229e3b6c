"""A closer look: people whom ground vehicles recognize tell which of the aerial camera's targets are human."""

import time
from dataclasses import replace

import numpy as np

from torchvision_dddas import geometry
from torchvision_dddas.config import Settings
from torchvision_dddas.control.expected_regions import expected_regions
from torchvision_dddas.geo.ranging import range_people
from torchvision_dddas.people.collaboration import Beliefs, Look, look, view_of
from torchvision_dddas.people.confirmation import confirmed_by
from torchvision_dddas.people.detector import people_in
from torchvision_dddas.people.scorer import WindowScorer
from torchvision_dddas.types import AerialLocations, Confirmation, GroundPicture, Poses

# People do not run faster.
_RUNNING_M_S = 4.0


def slow_enough(seen: Look, velocity_m_s: np.ndarray) -> Look:
    """The look without the people at what goes faster than people do, (N, 2): they stand beside its way."""
    fast = np.linalg.norm(velocity_m_s, axis=1) > _RUNNING_M_S  # False where unknown
    return replace(seen, looked=seen.looked & ~(fast & (seen.people > 0)))


class CloserLook:
    """What is believed of each target, as pictures from the ground come in."""

    def __init__(self, settings: Settings, recognizer: WindowScorer) -> None:
        self._settings, self._recognizer = settings, recognizer
        self._beliefs = Beliefs(settings.confirm)
        self._waiting: list[GroundPicture] = []
        self.pictures = 0
        self.spent_s = 0.0

    def take(self, pictures: list[GroundPicture]) -> None:
        """Pictures of the frames to come, as targets are located some frames later."""
        self._waiting += pictures

    def confirm(self, grounded: AerialLocations, extent_m: np.ndarray) -> Confirmation:
        """What is known of the targets of a frame, by the pictures taken at it and all before.

        extent_m: (P,) radius of each located target: its people stand about its middle.
        """
        here = [picture for picture in self._waiting if picture.frame <= grounded.frame]
        self._waiting = [picture for picture in self._waiting if picture.frame > grounded.frame]
        start = time.perf_counter()
        positions = grounded.positions
        looks = [(p.vehicle, self._look(p, grounded, extent_m)) for p in here if p.frame == grounded.frame]
        targets = positions.target.tolist()
        self._beliefs.add(targets, looks)
        self.pictures += len(looks)
        self.spent_s = time.perf_counter() - start
        return confirmed_by(grounded.frame, slice(0, len(targets)), targets, self._beliefs, looks)

    def _look(self, picture: GroundPicture, grounded: AerialLocations, extent_m: np.ndarray) -> Look:
        settings, camera, positions = self._settings, picture.camera, grounded.positions
        place = np.array([camera.place], float)
        if positions.origin_deg is not None:
            place = geometry.east_north(place, positions.origin_deg)
        # What is known from the air tells where to look, and how large people are there.
        regions = expected_regions(
            positions.east_north_m,
            positions.covariance_m2,
            extent_m,
            camera,
            place[0],
            camera.heading_rad,
            settings.ground,
        )
        (people,) = people_in([picture.image], self._recognizer, settings.people, [regions])
        rows = np.zeros(len(people), np.int64)
        poses = Poses(
            np.array([camera.place], float)[rows],
            np.full(len(people), camera.heading_rad),
            np.full(len(people), camera.pitch_rad),
        )
        seen = range_people(people.box_px, people.cut, camera, poses, place[rows], settings.ground)
        known = seen.by != "bearing"
        view = view_of(camera, place[0], camera.heading_rad, settings.people, settings.ground)
        # People of a crowd stand within it, not at its middle: half its radius is about their standard deviation.
        spread = positions.covariance_m2 + (extent_m[:, None, None] / 2) ** 2 * np.eye(2)
        found = look(
            positions.east_north_m,
            spread,
            seen.east_north_m[known],
            seen.covariance_m2[known],
            people.score[known],
            [view],
            settings.confirm,
        )
        return slow_enough(found, grounded.velocity_m_s)
