"""What the UAV's camera films of a simulated world, and the truth of every pixel."""

import numpy as np

from torchvision_dddas.simulation.moment import Moment
from torchvision_dddas.simulation.painting import Painter
from torchvision_dddas.simulation.scenario import Scenario
from torchvision_dddas.simulation.sensor import Sensor
from torchvision_dddas.simulation.shutter import Shutter
from torchvision_dddas.simulation.terrain import Terrain
from torchvision_dddas.simulation.world import World
from torchvision_dddas.types import Camera


class AerialCamera:
    """The UAV's camera above a world. A picture depends on the seed and its moment alone, not on those before it."""

    def __init__(self, world: World, scenario: Scenario) -> None:
        knobs = scenario.camera
        size = knobs.width_px, knobs.height_px
        focal = size[0] / 2 / np.tan(np.radians(knobs.hfov_deg) / 2)
        self.camera = Camera("uav", size, (focal, focal), ((size[0] - 1) / 2, (size[1] - 1) / 2))
        shutter = Shutter(self.camera, knobs.readout_s)
        self._terrain = Terrain(world, shutter)
        self._painter = Painter(world, shutter, scenario.seed)
        self._sensor = Sensor(knobs, size, scenario.seed)

    def take(self, moment: Moment) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The picture (H, W, 3) uint8 BGR, its targets (H, W) uint16 and its bodies (H, W) uint16; 0: neither."""
        lie = self._terrain.lie(moment)
        picture = self._terrain.texture(lie)
        targets, bodies = (np.zeros(picture.shape[:2], np.uint16) for _ in range(2))
        self._painter.paint(moment, picture, targets, bodies, lie.rise_m)
        return self._sensor.expose(picture, moment.number, moment.time_s), targets, bodies
