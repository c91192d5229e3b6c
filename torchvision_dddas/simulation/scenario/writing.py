"""A scenario as a file that is read as the same one."""

import json

from torchvision_dddas.simulation.scenario.parameters import Scenario


def as_toml(scenario: Scenario) -> str:
    """The whole scenario as a file that `load` reads."""
    lines: list[str] = []
    content = scenario.model_dump(mode="json")
    for key, value in content.items():
        if not isinstance(value, (dict, list)):
            lines.append(f"{key} = {_toml(value)}")
    for key, value in content.items():
        tables = value if isinstance(value, list) else [value] if isinstance(value, dict) and key != "settings" else []
        for table in tables:
            lines += ["", f"[[{key}]]" if isinstance(value, list) else f"[{key}]"]
            lines += [f"{name} = {_toml(entry)}" for name, entry in table.items()]
    for group, parameters in content["settings"].items():
        lines += ["", f"[settings.{group}]", *(f"{name} = {_toml(entry)}" for name, entry in parameters.items())]
    return "\n".join(lines) + "\n"


def _toml(value: object) -> str:
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(_toml(entry) for entry in value) + "]"
    # Numbers, words and truth values are written alike in JSON, but that its words may not hold DEL.
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
