"""Effects on aerial pictures of the ground: moving water, the UAV's own shadow, a thermal camera."""

import cv2
import numpy as np

from torchvision_dddas.lab.simulation.aerial_ground import PixelPlaces
from torchvision_dddas.lab.simulation.world import SHADE_BGR, shore_north_m

WARM_LEVELS = {"person": 215.0, "car": 125.0, "ugv": 125.0}
"""Grey levels of bodies in a thermal picture."""

_WATER_BGR = np.array([96.0, 88, 62])
_SKY_BGR = np.array([120.0, 110, 96])  # added to water whose slope reflects the bright sky
_WAVES_M = np.geomspace(0.4, 5.0, 16)  # wavelengths
_STEEPNESS = 0.09  # slope of each wave
_FOAM_M = 0.5  # width of the bright edge
_SUN_RAD = 0.0093  # angular diameter of the sun, which blurs shadows
_COOL, _CONTRAST = 70.0, 0.3  # thermal level of the ground; share of its daylight contrast that remains


def draw_water(picture: np.ndarray, places: PixelPlaces, shore_m: float, time_s: float) -> None:
    """Draw water with deep-water waves on a picture (H, W, 3) uint8, in place."""
    east, north = places.east_m, places.north_m
    depth = shore_north_m(east, shore_m) - north
    wet = depth > 0 if places.rise_m is None else (depth > 0) & (places.rise_m <= 0)
    if not wet.any():
        return
    east, north, depth, slope = east[wet], north[wet], depth[wet], np.zeros(int(wet.sum()), np.float32)
    pixel_m = np.broadcast_to(places.pixel_m[:, None], wet.shape)[wet]
    for k, length in enumerate(_WAVES_M):
        number, turn = 2 * np.pi / length, 0.5 + 1.2 * np.sin(2.4 * k)
        phase = number * (east * np.sin(turn) + north * np.cos(turn)) - np.sqrt(9.81 * number) * time_s + 1.7 * k
        # Waves shorter than two pixels average out.
        slope += np.clip(length / pixel_m - 2, 0, 1) * np.sin(phase)
    bright = np.clip(_STEEPNESS * slope + 0.3, 0, 1) ** 2
    foam = np.exp(-depth / _FOAM_M) * (0.6 + 0.4 * np.sin(0.9 * time_s + east / 2))
    picture[wet] = np.clip(_WATER_BGR + bright[:, None] * _SKY_BGR + 60 * foam[:, None], 0, 255)


def draw_own_shadow(
    picture: np.ndarray, places: PixelPlaces, place_m: np.ndarray, height_m: float, to_sun: np.ndarray, size_m: float
) -> None:
    """Darken the shadow of a UAV of size_m at place_m (3,), height_m above the ground, in place."""
    east, north = (place_m - height_m / max(float(to_sun[2]), 0.1) * to_sun)[:2]
    far = height_m / max(float(to_sun[2]), 0.1)
    blur = _SUN_RAD * far / 2
    spread = np.hypot(size_m / 2, blur)
    away = ((places.east_m - east) ** 2 + (places.north_m - north) ** 2) / spread**2
    # A UAV that looks smaller than the sun blocks only a part of the light.
    share = np.exp(-away) * min(1.0, (size_m / (_SUN_RAD * far)) ** 2)
    picture[:] = picture * (1 - share[..., None] * (1 - SHADE_BGR))


def cool_ground(picture: np.ndarray) -> np.ndarray:
    """Return a picture of ground and objects, (H, W, 3) uint8, as seen by a thermal camera: dark, low contrast."""
    grey = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
    levels = _COOL + _CONTRAST * (np.arange(256) - 110)
    return cv2.cvtColor(cv2.LUT(grey, np.clip(levels, 0, 255).astype(np.uint8)), cv2.COLOR_GRAY2BGR)
