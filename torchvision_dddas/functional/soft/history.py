"""A motion history that forgets softly: stamps fade around the duration, and half a silhouette is half a stamp.

For losses of one's own on silhouettes over time; no family of `tuning` takes it. The pipeline's history parts blobs, by
counting, and tells headings: a mask has no slope by how long it lasts.
"""

from jaxtyping import Float
from torch import Tensor

from torchvision_dddas.functional import history as hard
from torchvision_dddas.functional.threshold import step


def update(
    history: Float[Tensor, "B 1 H W"],
    silhouette: Float[Tensor, "B 1 H W"],
    now_s: float | Tensor,
    duration_s: float | Tensor,
    softness: float = 0.0,
) -> Float[Tensor, "B 1 H W"]:
    """As `ops.history.update`: now where the silhouette is, nothing where the stamp is older than the duration.

    Softness is in the silhouette's unit about one half, and a share of the duration about its end.
    """
    if softness == 0.0:
        return hard.update(history, silhouette, now_s, duration_s)
    fresh = step(silhouette - 0.5, softness)
    kept = history * step(1 - (now_s - history) / duration_s, softness)
    return fresh * now_s + (1 - fresh) * kept
