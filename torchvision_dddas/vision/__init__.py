"""Back ends: the same maps of what moves, from torch tensors or from OpenCV."""

import os
from importlib.util import find_spec

from torchvision_dddas.errors import InputError
from torchvision_dddas.settings import PeopleKnobs, Settings
from torchvision_dddas.types import LinearSvm
from torchvision_dddas.vision.protocol import ColourFinder, Foreground, PlaneSolver, Recognizer, View, Vision, Window

__all__ = [
    "ColourFinder",
    "Foreground",
    "PlaneSolver",
    "Recognizer",
    "View",
    "Vision",
    "Window",
    "load",
    "load_colours",
    "load_recognizer",
    "load_solver",
]


def load(backend: str, settings: Settings) -> Vision:
    """The back end `torch` or `onboard`; `auto` takes onboard, the quicker one for a single stream on a CPU.

    Raises InputError for another name, and for `torch` where the extra is not installed.
    """
    if not _torch_wanted(backend):
        from torchvision_dddas.vision.onboard_vision import OnboardVision

        return OnboardVision(settings)
    from torchvision_dddas.vision.torch_vision import TorchVision

    return TorchVision(settings)


def load_recognizer(backend: str, knobs: PeopleKnobs, svm: LinearSvm) -> Recognizer:
    """What scores windows for people, on the back end that `load` would take. Raises InputError as `load` does."""
    if not _torch_wanted(backend):
        from torchvision_dddas.vision.onboard_people import OnboardRecognizer

        return OnboardRecognizer(knobs, svm)
    from torchvision_dddas.vision.torch_people import TorchRecognizer

    return TorchRecognizer(knobs, svm)


def load_solver(backend: str) -> PlaneSolver:
    """What solves plane homographies, on the back end that `load` would take. Raises InputError as `load` does."""
    if not _torch_wanted(backend):
        from torchvision_dddas.vision.onboard_plane import OnboardSolver

        return OnboardSolver()
    from torchvision_dddas.vision.torch_plane import TorchSolver

    return TorchSolver()


def load_colours(backend: str) -> ColourFinder:
    """What finds colours, on the back end that `load` would take. Raises InputError as `load` does."""
    if not _torch_wanted(backend):
        from torchvision_dddas.vision.onboard_colours import OnboardColours

        return OnboardColours()
    from torchvision_dddas.vision.torch_colours import TorchColours

    return TorchColours()


def _torch_wanted(backend: str) -> bool:
    """Whether the back end is torch, which is then made ready to be imported."""
    if backend in ("auto", "onboard"):
        return False
    if backend != "torch":
        raise InputError(f"no back end is named '{backend}'; give auto, torch or onboard")
    if missing := [name for name in ("torch", "kornia") if find_spec(name) is None]:
        raise InputError(
            f"--backend torch needs {' and '.join(missing)}; pip install 'torchvision-dddas[torch]', "
            "or take --backend onboard"
        )
    # Waiting threads that spin take the cores from the threads they wait for, minutes a frame on a busy machine.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    return True
