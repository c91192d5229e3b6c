"""Linear SVMs from files: the shipped coefficients, or a user's own."""

from pathlib import Path

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.types import LinearSvm

SHIPPED = {"opencv": Path(__file__).parents[1] / "models" / "opencv_people.txt"}


def read_classifier(name: str | Path, features: int) -> LinearSvm:
    """The classifier of a shipped name, or of a file; features: the length of the descriptor it must fit.

    Raises InputError with both lengths where it does not fit.
    """
    path = SHIPPED.get(str(name), Path(name))
    numbers = np.loadtxt(path, dtype=np.float64).astype(np.float32)
    if len(numbers) not in (features, features + 1):
        raise InputError(
            f"{path} has {len(numbers)} numbers; a descriptor of these settings has {features}, so that {features} "
            "weights, or these and a bias, are wanted"
        )
    return LinearSvm(numbers[:features], float(numbers[features:].sum()), str(path))
