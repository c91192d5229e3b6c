"""Gradients of 8-bit pictures by OpenCV: their magnitude and direction, as HOG takes them. No torch."""

import math

import cv2
import numpy as np


class Gradient:
    """`ops.hog.gradient` and `angle` for one tile of a picture after the other, in buffers that are used again.

    A few passes by OpenCV over all channels at once, on tiles that stay in the cache: a sixth of what ONNX Runtime takes
    for the same. One object a thread.
    """

    def __init__(self, gamma: bool, signed: bool) -> None:
        """gamma: of square roots of the levels. signed: directions of a whole turn; false folds them into half a one."""
        levels = np.arange(256, dtype=np.float32)
        self.table = np.sqrt(levels) if gamma else levels
        self.signed = signed
        self.buffer = np.empty(0, np.float32)

    def __call__(self, planes: np.ndarray) -> np.ndarray:
        """(1, 2, H, W) float32 of planes uint8 (C, H + 2, W + 2): magnitude, and magnitude x direction in radians.

        Valid until the next call. Of channels whose magnitudes are equal the first wins.
        """
        channels, height, width = planes.shape[0], planes.shape[1] - 2, planes.shape[2] - 2
        # Planes stand above one another, each with its border: rows of the differences between two planes mean nothing.
        tall = channels * (height + 2)
        levels, dx, dy, square, polar = self._buffers(
            (tall, width + 2),
            *[(tall - 2, width)] * 2,
            (tall - 2 if channels > 1 else 0, width),
            (1, 2, height, width),
        )
        for channel, plane in enumerate(planes):
            cv2.LUT(plane, self.table, dst=levels[channel * (height + 2) : (channel + 1) * (height + 2)])
        cv2.subtract(levels[1:-1, 2:], levels[1:-1, :-2], dst=dx)
        cv2.subtract(levels[2:, 1:-1], levels[:-2, 1:-1], dst=dy)
        best_dx, best_dy = dx[:height], dy[:height]
        magnitude, angle = polar[0]
        if channels > 1:
            other = levels.ravel()[: square.size].reshape(square.shape)  # the levels are no longer needed
            # Not `accumulateSquare`, which rounds but once: of channels nearly equal another would win.
            cv2.add(cv2.multiply(dx, dx, dst=square), cv2.multiply(dy, dy, dst=other), dst=square)
            largest = square[:height]
            for channel in range(1, channels):
                here = slice(channel * (height + 2), channel * (height + 2) + height)
                wins = cv2.compare(square[here], largest, cv2.CMP_GT)
                cv2.copyTo(dx[here], wins, best_dx)
                cv2.copyTo(dy[here], wins, best_dy)
                cv2.max(square[here], largest, dst=largest)
        cv2.cartToPolar(best_dx, best_dy, magnitude=magnitude, angle=angle)
        if not self.signed:
            half_turn = cv2.threshold(angle, math.pi, math.pi, cv2.THRESH_BINARY, dst=best_dx)[1]
            cv2.subtract(angle, half_turn, dst=angle)
        cv2.multiply(angle, magnitude, dst=angle)
        return polar

    def _buffers(self, *shapes: tuple[int, ...]) -> list[np.ndarray]:
        ends = np.cumsum([math.prod(shape) for shape in shapes])
        if self.buffer.size < ends[-1]:
            self.buffer = np.empty(int(ends[-1]), np.float32)
        parts = np.split(self.buffer[: ends[-1]], ends[:-1])
        return [part.reshape(shape) for part, shape in zip(parts, shapes, strict=True)]
