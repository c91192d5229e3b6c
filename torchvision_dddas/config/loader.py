"""Read settings from TOML files and `group.parameter=value` overrides."""

import re
import tomllib
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import tomli_w
from pydantic import ValidationError
from pydantic.fields import FieldInfo

from torchvision_dddas.config.settings import Settings, parameter_fields, range_of, unit_of
from torchvision_dddas.errors import InputError, printable


def load_config(
    config: str | Path | None = None, overrides: Sequence[str] = (), *, base: Mapping[str, object] | None = None
) -> Settings:
    """Return the default settings, changed first by base, then by TOML files, and then by the overrides.

    config: the name of a shipped configuration (`source`, `fast`), a TOML file, or several of them separated by commas;
    later ones override earlier ones. overrides: `group.parameter=value`. base: `{"group.parameter": value}`.
    Raises InputError with one line for a missing file, bad TOML, an unknown parameter (with the nearest names), and a
    value out of range.

    >>> settings = td.load_settings("fast", ["gates.min_area_px=80"])
    >>> settings.registration.keypoints, settings.gates.min_area_px
    (200, 80)
    """
    settings = with_parameters(Settings(), base or {})
    several = isinstance(config, str) and "," in config and not is_file(Path(config))
    for one in str(config).split(",") if several else [] if config is None else [config]:
        path = _config_file(one)
        settings = with_parameters(settings, _flat(read_toml(path), str(path)), origin=str(path))
    return with_parameters(settings, dict(parse_override(text) for text in overrides))


def with_parameters(settings: Settings, values: Mapping[str, object], origin: str = "") -> Settings:
    """Return a copy of the settings with changed values, `{"group.parameter": value}`, and check all values again.

    origin: source of the values, which error messages start with. Raises InputError for an unknown parameter or a bad
    value.
    """
    before = f"{origin}: " if origin else ""
    fields = dict(parameter_fields())
    content = settings.model_dump(exclude_unset=True)
    for name, value in values.items():
        if name not in fields:
            raise InputError(f"{before}unknown parameter '{name}'; {nearest(name, list(fields))}")
        group, key = name.split(".")
        content.setdefault(group, {})[key] = tuple(value) if isinstance(value, list) else value
    try:
        return Settings.model_validate(content)
    except ValidationError as error:
        raise InputError(before + _explain(error, fields)) from None


def config_names() -> list[str]:
    """Return the names of the shipped configurations, which `--config` accepts."""
    return sorted(path.stem for path in config_folder().glob("*.toml"))


def config_folder() -> Path:
    """Return the folder of shipped configurations: in the package of a wheel, or at the top of a checkout."""
    package = Path(__file__).resolve().parents[1]
    return next((p for p in (package / "configs", package.parent / "configs") if p.is_dir()), package / "configs")


def _config_file(config: str | Path) -> Path:
    path = Path(config)
    if is_file(path):
        return path
    if path.suffix == ".toml" or len(path.parts) > 1:
        raise InputError(f"no such configuration file: {path}")
    shipped = config_folder() / f"{config}.toml"
    if not is_file(shipped):
        raise InputError(
            f"no configuration is named '{config}'; give one of {', '.join(config_names())}, or a TOML file"
        )
    return shipped


def is_file(path: Path) -> bool:
    """Return whether the file exists. It is False for names that are invalid for a file."""
    try:
        return path.is_file()
    except OSError:  # the name is too long, or the folder may not be entered
        return False


def read_toml(path: str | Path, what: str = "") -> dict[str, Any]:
    """Read a TOML file. what: the kind of file, for messages. Raises InputError with file and line."""
    name = f"{what} {path}".strip()
    try:
        text = Path(path).read_text(encoding="utf-8-sig")
        # The time of the parser grows with the square of a key's length.
        if any(line.count(".") > _MOST_DOTS and _has_long_key(line) for line in text.splitlines()):
            raise ValueError(f"a key has more than {_MOST_DOTS} dots")
        return tomllib.loads(text)
    except OSError as error:
        raise InputError(f"{name} cannot be read: {error.strerror}") from None
    except RecursionError:
        raise InputError(f"{name} is not valid TOML: its brackets are nested too deeply") from None
    except ValueError as error:  # the text is not UTF-8 or not TOML, or has a number of thousands of digits
        raise InputError(f"{name} is not valid TOML: {str(error).split(';')[0]}") from None


_MOST_DOTS = 100


def _has_long_key(line: str) -> bool:
    """Return whether a line has a key with too many parts, a.b.c, and not only many decimal numbers."""
    run = 0
    for part in line.split("."):
        run = run + 1 if (word := part.strip()) and not set(word) & set(" ,=\t") else 0
        if run > _MOST_DOTS:
            return True
    return False


def format_toml(content: Mapping[str, Any], comments: Sequence[str] = ()) -> str:
    r"""Return TOML text of plain values, lists and tables, which read_toml can read back. comments: lines above it.

    TOML cannot contain lone surrogates, which stand for bytes of file names that are not UTF-8. They become text such
    as \udc80.
    """
    text = tomli_w.dumps(_whole_characters(content), indent=1)
    while (shorter := _ARRAY.sub(lambda found: "[" + ", ".join(re.split(r",\n *", found[1])[:-1]) + "]", text)) != text:
        text = shorter
    lines = [printable(" ".join(comment.splitlines())) for comment in comments]
    return "".join(f"# {line}\n" for line in lines) + ("\n" if comments else "") + text


# An array without nested arrays, with one element on each line, as tomli_w writes it.
_ARRAY = re.compile(r"\[\n +((?:[^\n]*,\n *)+?)\]")


def _whole_characters(value: Any) -> Any:
    if isinstance(value, str):
        return value.encode("utf-8", "backslashreplace").decode()
    if isinstance(value, Mapping):
        return {_whole_characters(key): _whole_characters(inner) for key, inner in value.items()}
    return [_whole_characters(inner) for inner in value] if isinstance(value, list | tuple) else value


def _flat(content: dict[str, Any], origin: str) -> dict[str, object]:
    """Convert `{group: {parameter: value}}` to `{"group.parameter": value}`."""
    flat: dict[str, object] = {}
    for group, parameters in content.items():
        if not isinstance(parameters, dict):
            hint = nearest(group, [name for name, _ in parameter_fields()])
            raise InputError(f"{origin}: '{group}' is outside of a [group]; {hint}")
        flat |= {f"{group}.{name}": value for name, value in parameters.items()}
    return flat


def parse_override(text: str) -> tuple[str, object]:
    """Split `group.parameter=value` into name and value. Raises InputError for text of another form."""
    name, equals, value = (part.strip() for part in text.partition("="))
    if not equals or not name or not value:
        raise InputError(
            f"'{text}' is not an override; wanted group.parameter=value, such as registration.keypoints=500"
        )
    try:
        return name, tomllib.loads(f"value = {value}")["value"]
    except (ValueError, RecursionError):  # RecursionError comes from too many brackets, which no parameter takes
        try:
            return name, float(value)  # TOML accepts 0.3 but not .3
        except ValueError:
            return name, value  # a word without quotes, for a choice such as affine


def nearest(name: str, known: list[str], where: str = "`dddas settings` lists them all") -> str:
    """Return a hint with similar names, compared as a whole or by the parameter alone, or else `where`."""
    key = name.rpartition(".")[2]
    same = [full for full in known if full.rpartition(".")[2] == key]
    alike = get_close_matches(key, [full.rpartition(".")[2] for full in known], n=2)
    near = same + get_close_matches(name, known, n=3) + [k for k in known if k.rpartition(".")[2] in alike]
    near = list(dict.fromkeys(near))[:3]
    return f"did you mean {' or '.join(near)}?" if near else where


def _explain(error: ValidationError, fields: Mapping[str, FieldInfo]) -> str:
    """Describe the first error in one line: parameter, value, allowed range and unit."""
    first = error.errors()[0]
    name = ".".join(str(part) for part in first["loc"][:2])
    if name not in fields:  # the error is from a rule about several parameters of a group
        return f"{name}: {str(first['msg']).removeprefix('Value error, ')}"
    return describe_error(name, first["input"], fields[name])


def describe_error(name: str, value: object, field: FieldInfo) -> str:
    """Say which range and unit a parameter must have, and which value it got."""
    words, comma, odd = range_of(field).partition(",")
    if field.annotation in (int, float):
        words = f"{'a whole number ' if field.annotation is int else ''}between {words.replace(' to ', ' and ')}"
    unit = "" if unit_of(field) in ("-", "") else f" {unit_of(field)}"
    return f"{name} must be {words}{unit}{comma}{odd}, got {value!r}"
