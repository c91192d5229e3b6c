"""Base class of a group of parameters, and the definition of a parameter by default, unit, range and meaning."""

from collections.abc import Iterator
from inspect import cleandoc
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

if TYPE_CHECKING:
    from pydantic._internal._model_construction import ModelMetaclass
else:
    ModelMetaclass = type(BaseModel)


def odd(value: int) -> int:
    """Return the value if it is odd, else raise ValueError."""
    if value % 2 == 0:
        raise ValueError("not odd")
    return value


Odd = Annotated[int, AfterValidator(odd)]


def parameter(default: Any, meaning: str, unit: str = "-", low: float | None = None, high: float | None = None) -> Any:
    """Define a field of a group by its default, meaning, unit (`-` for a number without a unit) and inclusive range."""
    return Field(default, ge=low, le=high, description=meaning, json_schema_extra={"unit": unit})


class _ShortHelp(ModelMetaclass):
    def __dir__(cls) -> list[str]:
        """The names that `help` shows: without the hundred that pydantic adds."""
        return [name for name in vars(cls) if not name.startswith(("_", "model_"))]


class Group(BaseModel, metaclass=_ShortHelp):
    """Parameters of one subject. They are frozen; unknown names and silent conversions ("5" to 5) are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False, validate_default=True)

    @classmethod
    def __pydantic_init_subclass__(cls, **options: Any) -> None:
        """Add the parameters, or the groups, to the docstring: `help` shows what each of them means."""
        rows = []
        for name, field in cls.model_fields.items():
            extra = field.json_schema_extra
            unit = f" [{extra['unit']}]" if isinstance(extra, dict) and extra.get("unit", "-") != "-" else ""
            rows.append(
                f"{name}{unit}: {(field.description or type(field.default).__doc__ or '').partition(chr(10))[0]}"
            )
        cls.__doc__ = f"{cleandoc(cls.__doc__ or '')}\n\n" + "\n".join(rows)

    @model_validator(mode="after")
    def _lowest_below_highest(self) -> "Group":
        for low in type(self).model_fields:
            high = low.replace("minimum_", "maximum_").replace("min_", "max_").replace("_min", "_max")
            if high != low and high in type(self).model_fields and getattr(self, low) > getattr(self, high):
                raise ValueError(f"{low} = {getattr(self, low)} is above {high} = {getattr(self, high)}")
        return self

    def __repr_args__(self) -> Iterator[tuple[str, Any]]:
        """The parameters that differ from their defaults."""
        fields = type(self).model_fields
        return ((name, value) for name, value in self if value != fields[name].default)
