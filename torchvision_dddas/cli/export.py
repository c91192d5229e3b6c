"""`dddas export`: make ONNX graphs with a manifest, and compare each graph with torch before it is written."""

from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import typer

from torchvision_dddas.cli.options import Overrides, Quiet, echo, parse_size, print_lines, report_errors
from torchvision_dddas.errors import InputError

NEEDED = "torch", "kornia", "onnx", "onnxscript"


@report_errors
def export(
    out: Annotated[Path, typer.Option(help="Folder for the graphs.")] = Path("dddas-graphs"),
    graph: Annotated[
        list[str] | None, typer.Option("--graph", metavar="NAME", help="Graph to make; may be repeated. [default: all]")
    ] = None,
    size: Annotated[
        list[str] | None,
        typer.Option("--size", metavar="WxH", help="Picture size, for graphs of one size; may be repeated."),
    ] = None,
    config: Annotated[
        str, typer.Option(metavar="FILE|NAME", help="Parameters of the graphs: a TOML file or a shipped configuration.")
    ] = "fast",
    set_: Overrides = None,
    list_: Annotated[bool, typer.Option("--list", help="List the graphs without making them.")] = False,
    quiet: Quiet = False,
) -> None:
    """Make ONNX graphs of the torch functions, for the onboard engine and for accelerators.

    Writes the graphs and manifest.json (inputs, outputs, parameters, SHA-256, versions) under --out, once all of them
    agree with torch. `step` takes half a minute, the others seconds.
    """
    from torchvision_dddas.config import load_config
    from torchvision_dddas.lab.export import GRAPHS, export_graphs

    if list_:
        print_lines([f"{name:16s} {about}" for name, about in GRAPHS.items()])
        return
    sizes = [parse_size(text, 64, 8192) for text in size or ["640x480"]]
    settings = load_config(config, set_ or [])
    if out.exists() and not out.is_dir():
        raise InputError(f"--out {out} must be a folder for the graphs, got a file")
    if missing := [name for name in NEEDED if find_spec(name) is None]:
        raise InputError(f"dddas export needs {', '.join(missing)}; pip install 'torchvision-dddas[torch,export]'")
    from torchvision_dddas.lab.export.graph_files import ExportedGraph, write_graphs

    files: dict[str, ExportedGraph] = {}
    for name, found in export_graphs(graph or list(GRAPHS), settings, sizes):
        files |= found
        if not quiet:
            checks = "; ".join(
                f"{c.off:.1e} {c.unit} off, {c.limit:g} allowed" for c in next(iter(found.values())).checks
            )
            echo(f"{name}: {', '.join(found)}: compared with torch: {checks}", err=True)
    write_graphs(out, files)
    lines = [f"{out / name}: {len(made.content)} bytes" for name, made in files.items()]
    print_lines([*lines, str(out / "manifest.json")], quiet)
