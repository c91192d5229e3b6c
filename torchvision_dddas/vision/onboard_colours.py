"""Colours by OpenCV: no torch."""

import cv2
import numpy as np

HUE_TURN = 180  # OpenCV's 8-bit hue is in steps of two degrees


class OnboardColours:
    """Implements `ColourFinder`."""

    name = "onboard"

    def masks(self, image: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """By cv2.inRange, of one conversion; a grey picture has no colours."""
        found = np.zeros((len(low), *image.shape[:2]), np.uint8)
        if image.ndim == 2 or not len(low):
            return found
        hsv = cv2.cvtColor(image, cv2.COLOR_BGR2HSV)
        for mask, lowest, highest in zip(found, np.asarray(low, float), np.asarray(high, float), strict=True):
            if lowest[0] <= highest[0]:
                cv2.inRange(hsv, lowest, highest, dst=mask)
                continue
            cv2.inRange(hsv, lowest, np.array([HUE_TURN, *highest[1:]]), dst=mask)
            mask |= cv2.inRange(hsv, np.array([0, *lowest[1:]]), highest)
        return found
