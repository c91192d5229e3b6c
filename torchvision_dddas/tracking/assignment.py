"""Who is who between two or three frames: one-to-one assignment of the largest total score (appendix C, eq. 1-3).

Two frames: see `matching`. Three frames in which a gate left few triplets: see `columns`. Three frames with the
source's dummy targets and any triplet possible: exactly here, to within a gap in `relaxation`.
"""

import numpy as np

from torchvision_dddas.tracking.lagrangian import triplets
from torchvision_dddas.types import Float, Int


def triplets_exact(score: Float[np.ndarray, "N1 M1 L1"]) -> Int[np.ndarray, "Z 3"]:
    """The triplets (i, j, k) with the largest sum of scores, every real target of each frame in exactly one.

    score: (N + 1, M + 1, L + 1); index 0 of each axis is the dummy, used any number of times; (0, 0, 0) never is, and
    its score is not read. Scores may be zero or negative. Rows are sorted by i, then j, then k.
    Exact (to 1e-9 of the largest gain), so it may take for ever where many targets are alike: `relaxation.triplets`
    stops at a gap.
    Raises InputError if the score is no 3-D tensor with a dummy on each axis, or holds what is not finite.
    """
    return triplets(score, gap=0.0, most_exact=None).triplets
