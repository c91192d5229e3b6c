"""A graph with what it was compared with: it may be written only where every comparison is within its limit."""

from dataclasses import dataclass, field
from typing import Any

from torchvision_dddas.errors import InputError


@dataclass(frozen=True)
class Check:
    """How far a graph's results are from torch's, over its examples: `off` in `unit`, at most `limit` of it."""

    unit: str
    off: float
    limit: float

    @property
    def passed(self) -> bool:
        """False also where the difference is no number."""
        return self.off <= self.limit


@dataclass(frozen=True)
class Made:
    """One file: its content, what it is for, which of our functions it was compared with, the parameters baked in."""

    content: bytes
    about: str
    source: str
    parameters: dict[str, Any] = field(default_factory=dict)
    checks: tuple[Check, ...] = ()


def refuse_wrong(files: dict[str, Made]) -> None:
    """Raises InputError for a graph that does not compute what torch does, or was compared with nothing."""
    for name, made in files.items():
        wrong = [check for check in made.checks if not check.passed]
        if wrong or not made.checks:
            off = ", ".join(f"{c.off:.1e} {c.unit} where {c.limit:g} is allowed" for c in wrong) or "was never compared"
            raise InputError(
                f"{name} does not agree with {made.source}: {off}. Nothing was written; "
                "other versions of torch, onnx and onnxruntime may do better"
            )
