"""A group of parameters, and a parameter: default, unit, range and meaning."""

from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator


def odd(value: int) -> int:
    """The value if it is odd; else ValueError."""
    if value % 2 == 0:
        raise ValueError("not odd")
    return value


Odd = Annotated[int, AfterValidator(odd)]


def parameter(default: Any, meaning: str, unit: str = "-", low: float | None = None, high: float | None = None) -> Any:
    """A field of a group: default, meaning, unit (`-` for a bare number) and inclusive range."""
    return Field(default, ge=low, le=high, description=meaning, json_schema_extra={"unit": unit})


class Group(BaseModel):
    """Parameters of one subject: frozen, without unknown names or silent conversion ("5" is no number)."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False, validate_default=True)

    @model_validator(mode="after")
    def _lowest_below_highest(self) -> "Group":
        for low in type(self).model_fields:
            high = low.replace("minimum_", "maximum_").replace("min_", "max_").replace("_min", "_max")
            if high != low and high in type(self).model_fields and getattr(self, low) > getattr(self, high):
                raise ValueError(f"{low} = {getattr(self, low)} is above {high} = {getattr(self, high)}")
        return self
