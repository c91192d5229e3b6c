"""What the UAV's camera films of a simulated world, and the truth of every pixel."""

from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np

from torchvision_dddas.simulation.backdrop import HAZE
from torchvision_dddas.simulation.blur import smeared
from torchvision_dddas.simulation.moment import Moment
from torchvision_dddas.simulation.painting import Painter
from torchvision_dddas.simulation.scenario import Scenario
from torchvision_dddas.simulation.sensor import Sensor
from torchvision_dddas.simulation.shutter import Shutter
from torchvision_dddas.simulation.terrain import Lie, Terrain
from torchvision_dddas.simulation.world import World
from torchvision_dddas.types import Camera


class AerialCamera:
    """The UAV's camera above a world. A picture depends on the seed and its moment alone, not on those before it."""

    def __init__(self, world: World, scenario: Scenario) -> None:
        parameters = scenario.camera
        size = parameters.width_px, parameters.height_px
        focal = size[0] / 2 / np.tan(np.radians(parameters.hfov_deg) / 2)
        self.camera = Camera("uav", size, (focal, focal), ((size[0] - 1) / 2, (size[1] - 1) / 2))
        self._world, self._exposure_s = world, parameters.exposure_s
        self._shutter = Shutter(self.camera, parameters.readout_s, parameters.vibration_px, scenario.seed)
        self._terrain = Terrain(world, self._shutter)
        self._painter = Painter(world, self._shutter, parameters.exposure_s, scenario.seed)
        self._sensor = Sensor(parameters, size, scenario.seed)

    def take(self, moment: Moment) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The picture (H, W, 3) uint8 BGR, its targets (H, W) uint16 and its bodies (H, W) uint16; 0: neither."""
        # Both take about as long, and neither needs the other. A thread for each picture costs little, and none is left
        # behind in a process that forks.
        with ThreadPoolExecutor(1) as other:
            drawing = other.submit(self._painter.drawn, moment)
            lie = self._terrain.lie(moment)
            picture = self._terrain.texture(lie)
            drawn = drawing.result()
        targets, bodies = (np.zeros(picture.shape[:2], np.uint16) for _ in range(2))
        self._painter.paint(moment, drawn, picture, targets, bodies, lie.rise_m)
        if lie.haze is not None:
            air = np.empty_like(picture)
            air[:] = HAZE.astype(np.uint8)
            picture = np.asarray(cv2.blendLinear(picture, air, 1 - lie.haze, lie.haze))
        if self._exposure_s > 0:
            picture = smeared(picture, self._ways(moment, lie))
        return self._sensor.expose(picture, moment.number, moment.time_s), targets, bodies

    def _ways(self, moment: Moment, lie: Lie) -> np.ndarray:
        """(3, 3, 2) pixels that the ground moves in the picture while it is exposed, from corner to corner."""
        height, width = lie.east_m.shape
        row, column = np.meshgrid([0, height // 2, height - 1], [0, width // 2, width - 1], indexing="ij")
        place = np.stack([lie.east_m[row, column], lie.north_m[row, column]], axis=-1).reshape(-1, 2).astype(float)
        ground = np.c_[place, self._world.up_m(place)]
        return self._shutter.ways(moment, ground, self._exposure_s).reshape(3, 3, 2).astype(np.float32)
