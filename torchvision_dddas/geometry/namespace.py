"""Formulas that NumPy and torch share take their functions from here."""

import sys
from typing import Any

import numpy as np


def namespace(x: Any) -> Any:
    """NumPy for an array, torch for a tensor; nothing is imported: who has a tensor has torch."""
    return np if isinstance(x, np.ndarray) else sys.modules["torch"]
