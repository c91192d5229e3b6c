"""What moves in the clips of a study, several of one size at once, before the jobs are shared.

On a CPU that gains nothing: a clip's own windows fill a batch (`eval/batches_gain.py`). A GPU wants more at once than
one clip has, and one process to ask it. Results are kept under the keys of the single clips: on a CPU they are the same
to the last digit.
"""

from collections import defaultdict
from collections.abc import Callable, Sequence
from typing import Any

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.studies import digests
from torchvision_dddas.evaluation.studies.batches import find_motion_together
from torchvision_dddas.evaluation.studies.cache import Cache
from torchvision_dddas.evaluation.studies.record import Found
from torchvision_dddas.evaluation.studies.stages import opened, upstream
from torchvision_dddas.evaluation.studies.worker import one_thread
from torchvision_dddas.evaluation.studies.working import Job, Keys


def motion_ahead(
    jobs: Sequence[Job], cache: Cache, together: int, tell: Callable[[str], Any] = lambda line: None
) -> int:
    """Find what moves in all clips of which it is wanted from torch and not kept, and keep it; how many clips.

    together: clips at once, each with windows of its own in flight.

    A clip that cannot be read, and a group that fails, are left to their own jobs, which say why. tell: is given a
    line for each such group.
    """
    wanted = [job for job in jobs if job.backend == "torch"]
    if not wanted:
        return 0
    import torch  # noqa: F401 (before it is held to one thread, as a worker is: sums of others differ by digits)

    one_thread()
    files = digests.Files(cache.folder / "files")
    groups: dict[Any, list[tuple[Job, str]]] = defaultdict(list)
    for job in wanted:
        if not any("motion" in (task, upstream(job.clip, task)) for task in job.tasks):
            continue
        try:
            key, size = Keys(job, files).found("motion"), opened(job.clip).size
        except InputError:
            continue
        if not cache.has(key):
            groups[size, job.settings].append((job, key))
    kept = 0
    for group in groups.values():
        for first in range(0, len(group), together):
            kept += _together(group[first : first + together], cache, tell)
    return kept


def _together(group: Sequence[tuple[Job, str]], cache: Cache, tell: Callable[[str], Any]) -> int:
    job = group[0][0]
    try:
        found = find_motion_together([one.clip for one, _ in group], job.settings, job.backend)
    except Exception as error:  # such as no memory for so many: one clip at a time may still do
        names = ", ".join(one.clip.name for one, _ in group)
        tell(f"{names} could not be taken together ({type(error).__name__}: {error}); each is taken alone")
        return 0
    kept = 0
    for one, key in group:
        what = found[one.clip.name]
        if isinstance(what, Found):
            cache.put(key, what)
            kept += 1
    return kept
