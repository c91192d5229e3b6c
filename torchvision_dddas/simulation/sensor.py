"""The sensor model: lens blur, drifting exposure, noise, and JPEG compression."""

from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np

from torchvision_dddas.simulation.scenario import CameraParameters

_BAND, _BLOCK = 32, 16  # rows
_SPARE_PX = 192  # margin of the tile of noise, so that its start can vary


class Sensor:
    """The sensor of a camera. stream distinguishes cameras of one seed.

    What happens to a picture depends on the seed, the stream and the picture's number alone.
    """

    def __init__(self, parameters: CameraParameters, size_px: tuple[int, int], seed: int, stream: int = 0) -> None:
        self.parameters = parameters
        self._key = [seed, 71, stream]
        rng = np.random.default_rng(self._key)
        self._phase = rng.uniform(0, 2 * np.pi, 3)
        shape = (size_px[1] + _SPARE_PX, size_px[0] + _SPARE_PX, 3)
        self._noisy = parameters.shot_noise > 0 or parameters.read_noise > 0
        self._tile = rng.standard_normal(shape, np.float32) if self._noisy else None

    def gain(self, time_s: float) -> float:
        """The exposure beside its middle: slow, of a few periods, within 1 - drift to 1 + drift."""
        waves = np.sin(2 * np.pi * time_s / np.array([11.0, 4.3, 27.0]) + self._phase)
        return 1 + self.parameters.drift * float(waves @ (0.5, 0.2, 0.3))

    def expose(self, picture: np.ndarray, number: int, time_s: float) -> np.ndarray:
        """The file's picture, (H, W, 3) uint8, of what the lens looks at, the same; number: of the picture."""
        parameters = self.parameters
        levels = np.asarray(np.arange(256) * self.gain(time_s), np.float32)
        sigma = np.asarray(np.sqrt(parameters.shot_noise * levels + parameters.read_noise**2), np.float32)
        grain, turned = None, False
        if self._tile is not None:
            rng = np.random.default_rng([*self._key, number])
            y, x = rng.integers(0, _SPARE_PX, 2)
            grain = self._tile[y : y + picture.shape[0], x : x + picture.shape[1]]
            # Turned over and the sign changed, so that no two pictures show the same pattern moved aside.
            flip = int(rng.integers(0, 4))
            grain = grain[::-1] if flip in (0, 1) else grain
            turned = flip in (0, 2)
            if rng.integers(0, 2):
                sigma = -sigma
        if parameters.sharpness_px > 0:
            picture = np.asarray(cv2.GaussianBlur(picture, (0, 0), parameters.sharpness_px))
        developed = np.empty_like(picture)

        def develop(part: slice) -> None:
            if grain is None:
                cv2.LUT(picture[part], np.asarray(np.clip(np.round(levels), 0, 255), np.uint8), dst=developed[part])
            else:
                # Bands of rows that the processor's cache holds.
                for first in range(part.start, part.stop, _BAND):
                    rows = slice(first, min(first + _BAND, part.stop))
                    noise = cv2.LUT(picture[rows], sigma)
                    pattern = np.asarray(cv2.flip(grain[rows], 1)) if turned else grain[rows]
                    np.multiply(noise, pattern, out=noise)
                    cv2.add(cv2.LUT(picture[rows], levels), noise, dst=developed[rows], dtype=cv2.CV_8U)
            if parameters.quality < 100:
                _, file = cv2.imencode(".jpg", developed[part], [cv2.IMWRITE_JPEG_QUALITY, parameters.quality])
                developed[part] = cv2.imdecode(file, cv2.IMREAD_COLOR)

        # Two halves at a time: they share no block of the compression.
        middle, height = len(picture) // 2 // _BLOCK * _BLOCK, len(picture)
        with ThreadPoolExecutor(1) as other:
            upper = other.submit(develop, slice(0, middle)) if middle else None
            develop(slice(middle, height))
            if upper is not None:
                upper.result()
        return developed
