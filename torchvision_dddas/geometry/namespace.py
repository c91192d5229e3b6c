"""Choose between NumPy and torch for formulas that work on both arrays and tensors."""

import sys
from typing import Any

import numpy as np


def namespace(x: Any) -> Any:
    """Return NumPy for an array and torch for a tensor. A tensor implies that torch is imported already."""
    return np if isinstance(x, np.ndarray) else sys.modules["torch"]
