"""Export ONNX graphs (`dddas export`). Each graph is compared with torch before it is written. Needs torch and onnx.

The graphs for people are built node by node (people_graphs.py), so that they are fast on a small CPU. The others are
traced from `nn` by torch's exporter (traced_graphs.py). The package ships the graphs for people and homographies.
The same versions of the libraries write the same bytes.
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
    "people": "HOG and a linear SVM for people, in the layout of people.*; the default layout is shipped",
    "homography": "plane homographies from landmarks; shipped",
    "warp_difference": "warp, three-frame difference, threshold and morphology, for one picture size",
    "step": "the whole step from three pictures to the mask: keypoints, flow, RANSAC, refits, warp, difference",
}


def export_graphs(
    names: Sequence[str], settings: Settings, sizes_px: Sequence[tuple[int, int]]
) -> "Iterator[tuple[str, dict[str, ExportedGraph]]]":
    """Make the files of each graph in turn and compare them with torch, without writing. sizes_px: (width, height).

    Raises InputError for an unknown graph, and for settings that a graph does not support.
    """
    if unknown := [name for name in names if name not in GRAPHS]:
        raise InputError(f"no graph is named '{unknown[0]}'; choose from {', '.join(GRAPHS)}")
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # spinning threads would take cores from other threads
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
