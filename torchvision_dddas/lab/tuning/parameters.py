"""Parameters that gradients can move, and the transforms that keep them in their ranges."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Literal, TypeVar

import torch
from pydantic import BaseModel
from torch import Tensor, nn

from torchvision_dddas.config import Settings, with_parameters
from torchvision_dddas.errors import InputError

# A value at the end of its range has no gradient, so the start is moved inward by this share of the range.
_EDGE = 1e-3


@dataclass(frozen=True)
class Tunable:
    """One parameter that gradients can move between the limits of its field in `Settings`.

    log: steps multiply the value plus offset; otherwise they add to the value. The offset makes 0 reachable. rounding:
    rounding of the final value; during the descent the parameter is continuous.
    """

    name: str
    family: str
    low: float
    high: float
    unit: str = "-"
    log: bool = True
    offset: float = 0.0
    rounding: Literal["none", "whole", "odd"] = "none"

    def value(self, free: Tensor) -> Tensor:
        """Return the value for a free number. In mid-range, 1 more is a factor of about e, or adds 1 without `log`."""
        low, high = self._scaled(self.low), self._scaled(self.high)
        scaled = low + (high - low) * torch.sigmoid(free * (4.0 / (high - low)))
        return scaled.exp() - self.offset if self.log else scaled

    def free(self, value: float) -> float:
        """Return the free number for a value. A value at an end of the range is moved inward by a thousandth."""
        low, high = self._scaled(self.low), self._scaled(self.high)
        share = min(max((self._scaled(value) - low) / (high - low), _EDGE), 1.0 - _EDGE)
        return math.log(share / (1.0 - share)) * (high - low) / 4.0

    def rounded(self, value: float) -> float | int:
        """Return the value as the settings hold it: whole, odd, or with four digits, within the range."""
        value = min(max(value, self.low), self.high)
        if self.rounding == "none":
            return min(max(float(f"{value:.4g}"), self.low), self.high)
        if self.rounding == "whole":
            return round(value)
        return min(2 * math.floor(value / 2) + 1, int(self.high) - 1 + int(self.high) % 2)

    @property
    def range(self) -> str:
        """The range, such as `0.1 to 255` or `1 to 31, odd`."""
        return f"{self.low:g} to {self.high:g}" + (", odd" if self.rounding == "odd" else "")

    def _scaled(self, value: float) -> float:
        return math.log(value + self.offset) if self.log else float(value)


def _from_settings(family: str, group: str, names: str, **options: object) -> dict[str, Tunable]:
    found = {}
    for key in names.split():
        field = type(Settings.model_fields[group].default).model_fields[key]
        low, high = (
            float(next(limit for rule in field.metadata if (limit := getattr(rule, end, None)) is not None))
            for end in ("ge", "le")
        )
        unit = str(field.json_schema_extra["unit"]) if isinstance(field.json_schema_extra, dict) else "-"
        found[f"{group}.{key}"] = Tunable(f"{group}.{key}", family, low, high, unit, **options)  # type: ignore[arg-type]
    return found


# Not tunable: switches and choices; scores that select the detections; numbers of points, levels or frames, which
# change the graph; and parameters that count blobs (tracklets), because the pixels of a mask give them no gradient.
TUNABLE: dict[str, Tunable] = {
    **_from_settings("motion", "difference", "noise_levels threshold"),
    **_from_settings("motion", "difference", "gradient_share", offset=0.02),
    **_from_settings("motion", "difference", "peak", offset=1.0),
    **_from_settings("motion", "difference", "blur_px", rounding="odd"),
    **_from_settings("motion", "morphology", "erode_px dilate_px close_px", rounding="whole"),
    **_from_settings("motion", "gates", "min_area_px", rounding="whole"),
    **_from_settings("tracking", "track", "wander scatter size_scatter tail upright rest_drift"),
    **_from_settings("tracking", "track", "crossing", offset=0.01),
    **_from_settings("tracking", "track", "rest_price appearance_weight", offset=0.1),
    **_from_settings("tracking", "track", "hiding appearance_offset", log=False),
}


def expand_names(names: Iterable[str]) -> list[str]:
    """Return the names of tunable parameters, each once, in the given order; `difference.*` means all of a group.

    Raise InputError, with all tunable parameters and their ranges, for an unknown name.
    """
    found: dict[str, None] = {}
    for name in names:
        fitting = [known for known in TUNABLE if fnmatchcase(known, name)]
        if not fitting:
            known = ", ".join(f"{tunable.name} ({tunable.range})" for tunable in TUNABLE.values())
            raise InputError(f"'{name}' is not a parameter that can be tuned by gradient; give some of: {known}")
        found |= dict.fromkeys(fitting)
    if not found:
        raise InputError("no parameter to tune; name some, such as difference.threshold")
    return list(found)


class Parameters(nn.Module):
    """The tuned parameters as unbounded torch parameters. All other parameters keep the values of the settings."""

    def __init__(self, settings: Settings, names: Iterable[str]) -> None:
        """names: as for `expand_names`. Raise InputError for a parameter that cannot be tuned."""
        super().__init__()
        self.base, self.names = settings, expand_names(names)
        self._starts = [TUNABLE[name].free(value_of(settings, name)) for name in self.names]
        # Use double precision: a tensor without axes does not change the precision of a picture.
        self.free = nn.ParameterList([nn.Parameter(torch.tensor(s, dtype=torch.float64)) for s in self._starts])
        sizes = {name for name in self.names if TUNABLE[name].rounding != "none"}
        self._sizes = sizes if len(sizes) < len(self.names) else set()

    def values(self, whole: bool = False) -> dict[str, Tensor]:
        """Return each parameter's value: a float64 tensor without axes, with its gradient.

        whole: round sizes and give them no gradient, unless all parameters are sizes.
        """
        found = {name: TUNABLE[name].value(free) for name, free in zip(self.names, self.free, strict=True)}
        if whole and self._sizes:
            found |= {name: value for name, value in self.settled().items() if name in self._sizes}
        return found

    def moved(self, whole: bool = False) -> Tensor:
        """Return the sum of squares of the unconstrained steps from the start, with gradient. whole: as in `values`."""
        held = self._sizes if whole else set()
        ends = [free.detach() if name in held else free for name, free in zip(self.names, self.free, strict=True)]
        return torch.stack([(end - start) ** 2 for end, start in zip(ends, self._starts, strict=True)]).sum()

    def settled(self) -> dict[str, Tensor]:
        """Return the values, rounded as in the settings and without a gradient; otherwise as `values`."""
        settings = self.settings()
        return {
            name: free.new_tensor(value_of(settings, name)) for name, free in zip(self.names, self.free, strict=True)
        }

    def settings(self) -> Settings:
        """Return the settings with these values, rounded. Parameters that have not moved keep their exact values."""
        moved = {
            name: TUNABLE[name].rounded(float(value.detach()))
            for (name, value), free, start in zip(self.values().items(), self.free, self._starts, strict=True)
            if float(free.detach()) != start
        }
        return with_parameters(self.base, moved, origin="the tuned parameters")


def value_of(settings: Settings, name: str) -> float:
    """Return the value of a parameter as a float; name: group.parameter."""
    group, key = name.split(".")
    return float(getattr(getattr(settings, group), key))


_Group = TypeVar("_Group", bound=BaseModel)


def with_tensors(group: _Group, prefix: str, values: Mapping[str, Tensor]) -> _Group:
    """Return a group in which the parameters named `prefix.key` are tensors. Nothing is checked."""
    mine = {name.partition(".")[2]: value for name, value in values.items() if name.startswith(f"{prefix}.")}
    return type(group).model_construct(**{**dict(group), **mine})
