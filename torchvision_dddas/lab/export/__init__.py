"""ONNX graphs of our functions, each compared with torch before it is written: `dddas export`. Needs torch and onnx.

The graphs of people are built node by node (people_graphs.py), as ONNX Runtime runs them on a small CPU. The others are
traced from `nn` by torch's exporter (traced_graphs.py). The package ships those of people and of homographies.
The same versions write the same bytes.
"""

import os
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from torchvision_dddas.config import Settings
from torchvision_dddas.errors import InputError

if TYPE_CHECKING:
    from torchvision_dddas.lab.export.graph_files import ExportedGraph

__all__ = ["GRAPHS", "export_graphs"]

GRAPHS = {
    "people": "HOG and a linear SVM for people, of the layout of people.*; shipped for the default one",
    "homography": "plane homographies from landmarks; shipped",
    "warp_difference": "warp, three-frame difference, threshold and morphology, for one size of picture",
    "step": "the whole step from three pictures to the mask: keypoints, flow, RANSAC, refits, warp, difference",
}


def export_graphs(
    names: Sequence[str], settings: Settings, sizes_px: Sequence[tuple[int, int]]
) -> "Iterator[tuple[str, dict[str, ExportedGraph]]]":
    """Make the files of each graph in turn and compare them with torch; nothing is written. sizes_px: (width, height).

    Raises InputError for an unknown graph, and for settings that a graph cannot hold.
    """
    if unknown := [name for name in names if name not in GRAPHS]:
        raise InputError(f"no graph is named '{unknown[0]}'; there are {', '.join(GRAPHS)}")
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # waiting threads that spin take the cores from the others
    from torchvision_dddas.lab.export.people_graphs import export_people
    from torchvision_dddas.lab.export.traced_graphs import export_homographies, export_segmentation

    for name in dict.fromkeys(names):
        if name == "people":
            yield name, export_people(settings.people)
        elif name == "homography":
            yield name, export_homographies()
        else:
            for size_px in dict.fromkeys(sizes_px):
                yield name, export_segmentation(name, settings, size_px)
