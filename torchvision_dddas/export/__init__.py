"""ONNX graphs of our functions, each compared with torch before it is written: `dddas export`. Needs torch and onnx.

The graphs of people and of homographies are built node by node (people.py, plane.py), as ONNX Runtime runs them on a
small CPU; the package ships them. The others are traced from `ops` by torch's exporter (traced.py) for one size of
picture, for accelerators. The same versions write the same bytes.
"""

import os
from collections.abc import Iterator, Sequence

from torchvision_dddas.config import Settings
from torchvision_dddas.errors import InputError
from torchvision_dddas.export.checked import Made

__all__ = ["GRAPHS", "Made", "made"]

# What can be asked for, and what it is.
GRAPHS = {
    "people": "HOG and a linear SVM for people, of the layout of people.*; shipped for the default one",
    "homography": "plane homographies from landmarks; shipped",
    "warp_difference": "warp, three-frame difference, threshold and morphology, for one size of picture",
    "step": "the whole step from three pictures to the mask: keypoints, flow, RANSAC, refits, warp, difference",
}


def made(
    names: Sequence[str], settings: Settings, sizes: Sequence[tuple[int, int]]
) -> Iterator[tuple[str, dict[str, Made]]]:
    """The files of each graph in turn, compared with torch; nothing is written. sizes: (width, height) in px.

    Raises InputError for an unknown graph, and settings that a graph cannot hold.
    """
    if unknown := [name for name in names if name not in GRAPHS]:
        raise InputError(f"no graph is named '{unknown[0]}'; there are {', '.join(GRAPHS)}")
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # waiting threads that spin take the cores from the others
    for name in dict.fromkeys(names):
        if name == "people":
            from torchvision_dddas.export import people_graphs as people

            yield name, people.made(settings.people)
        elif name == "homography":
            from torchvision_dddas.export import plane_graphs as plane

            yield name, plane.made()
        else:
            from torchvision_dddas.export import traced_graphs as traced

            for size in dict.fromkeys(sizes):
                yield name, traced.made(name, settings, size)
