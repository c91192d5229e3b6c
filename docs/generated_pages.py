"""Text of the site's pages that comes from the code: tutorials from scripts, tables of commands and of settings."""

import re
from collections.abc import Iterable, Iterator
from typing import Any


def tutorial_page(script: str) -> str:
    """A tutorial's page in Markdown.

    The docstring is the beginning of the page. A line `# %%` ends a block of code; the comment below it is text.
    """
    _, intro, body = script.split('"""', 2)
    first, *cells = body.split("\n# %%\n")
    parts = [intro.strip(), _code(first)]
    for cell in cells:
        lines = cell.strip("\n").split("\n")
        count = next((k for k, line in enumerate(lines) if not line.startswith("#")), len(lines))
        parts += ["\n".join(line.removeprefix("#").removeprefix(" ") for line in lines[:count])]
        parts += [_code("\n".join(lines[count:]))]
    return "\n\n".join(part for part in parts if part) + "\n"


def _code(text: str) -> str:
    return f"```python\n{text.strip()}\n```" if text.strip() else ""


def commands_page() -> str:
    """Each command of `dddas` with its arguments and options, from its own help."""
    import typer

    from torchvision_dddas.cli import app

    return "\n".join(
        line for name, command in _commands(typer.main.get_command(app)) for line in _command(name, command)
    )


def _commands(group: Any, before: str = "dddas") -> Iterator[tuple[str, Any]]:
    for name, command in sorted(group.commands.items()):
        if hasattr(command, "commands"):
            yield from _commands(command, f"{before} {name}")
        else:
            yield f"{before} {name}", command


def _command(name: str, command: Any) -> Iterator[str]:
    yield from (f"## `{name}`", "", _escape(command.help or ""), "")
    rows = [_option(parameter) for parameter in command.params if parameter.name != "help"]
    yield from _table(("argument or option", "meaning", "default"), rows)


def _option(parameter: Any) -> tuple[str, str, str]:
    is_option = parameter.opts[0].startswith("-")
    words = "/".join([*parameter.opts, *parameter.secondary_opts])
    words = f"{words} {parameter.metavar or ''}".strip() if is_option else parameter.metavar or parameter.name.upper()
    meaning, default = parameter.help or "", parameter.default
    if found := re.search(r" ?\[default: ([^\]]*)\]", meaning):  # a default in words
        meaning, default = meaning.replace(found[0], ""), found[1]
    shown = "" if default in (None, False, (), []) else str(getattr(default, "value", default))
    return f"`{words}`", _escape(meaning), "required" if parameter.required else _escape(shown)


def settings_page() -> str:
    """Each parameter of the settings by group, then those of a scenario."""
    from torchvision_dddas.config import Settings, all_parameters
    from torchvision_dddas.lab.simulation import scenario_parameters

    lines = []
    for group, found in Settings.model_fields.items():
        about = (found.annotation.__doc__ or "").strip() if found.annotation else ""
        lines += [f"## `{group}`", "", _escape(about), ""]
        rows = [row for row in all_parameters() if row.name.startswith(f"{group}.")]
        lines += _parameters(rows, f"{group}.")
    lines += [
        "## Scenarios",
        "",
        "For `--scene` of `dddas run sim:NAME`, `--set` of `dddas simulate`, and TOML files.",
        "",
    ]
    return "\n".join([*lines, *_parameters(scenario_parameters())])


def _parameters(rows: Iterable[Any], group: str = "") -> Iterator[str]:
    cells = [
        (f"`{p.name.removeprefix(group)}`", _escape(str(p.default)), p.unit, _escape(p.range), _escape(p.meaning))
        for p in rows
    ]
    yield from _table(("parameter", "default", "unit", "range", "meaning"), cells)


def _table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> Iterator[str]:
    cells = [list(head), *map(list, rows)]
    cells.insert(1, ["---"] * len(cells[0]))
    yield from ("| " + " | ".join(cell.replace("|", "\\|").replace("\n", " ") for cell in row) + " |" for row in cells)
    yield ""


def _escape(text: str) -> str:
    """Markdown of a plain text; words between backticks stay code."""
    parts = text.split("`")
    parts[::2] = [re.sub(r"([*_<\[\]$~])", r"\\\1", part) for part in parts[::2]]
    return "`".join(parts)
