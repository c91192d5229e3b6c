"""Formulas that hold for arrays and for tensors alike: whose functions to call.

A tracker scores with NumPy and without torch; tuning by gradient takes the same formulas to tensors. What both
libraries name and mean alike is written once, as `namespace(x).log1p(x)`: on arrays it is NumPy itself.
"""

import sys
from typing import Any

import numpy as np


def namespace(x: Any) -> Any:
    """NumPy for an array, torch for a tensor; nothing is imported: who has a tensor has torch."""
    return np if isinstance(x, np.ndarray) else sys.modules["torch"]
