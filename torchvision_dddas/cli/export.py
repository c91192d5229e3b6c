"""`dddas export`: ONNX graphs with a manifest, each compared with torch before it is written."""

from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import typer

from torchvision_dddas.cli.mistakes import explained
from torchvision_dddas.cli.options import Overrides, Quiet
from torchvision_dddas.errors import InputError

NEEDED = "torch", "kornia", "onnx", "onnxscript"


@explained
def export(
    out: Annotated[Path, typer.Option(help="Folder for the graphs.")] = Path("dddas-graphs"),
    graph: Annotated[
        list[str] | None, typer.Option("--graph", metavar="NAME", help="Which; may be repeated. [default: all]")
    ] = None,
    size: Annotated[
        list[str] | None,
        typer.Option("--size", metavar="WxH", help="Size of the pictures, for graphs of one size; may be repeated."),
    ] = None,
    config: Annotated[
        str, typer.Option(metavar="FILE|NAME", help="Whose parameters the graphs hold: a TOML file or a name.")
    ] = "fast",
    set_: Overrides = None,
    list_: Annotated[bool, typer.Option("--list", help="Say which graphs there are, and make none.")] = False,
    quiet: Quiet = False,
) -> None:
    """Make the ONNX graphs of our functions, for the onboard back end and for accelerators.

    Writes the graphs and manifest.json (inputs, outputs, parameters, SHA-256, versions) under --out, once all agree
    with torch. `step` takes half a minute, the others seconds.
    """
    from torchvision_dddas.config import load_config
    from torchvision_dddas.export import GRAPHS, export_graphs

    if list_:
        for name, about in GRAPHS.items():
            typer.echo(f"{name:16s} {about}")
        return
    sizes = [size_of(text) for text in size or ["640x480"]]
    settings = load_config(config, set_ or [])
    if out.exists() and not out.is_dir():
        raise InputError(f"--out {out} is a file; wanted a folder for the graphs")
    if missing := [name for name in NEEDED if find_spec(name) is None]:
        raise InputError(f"dddas export needs {', '.join(missing)}; pip install 'torchvision-dddas[torch,export]'")
    from torchvision_dddas.export.graph_files import ExportedGraph, write_graphs

    files: dict[str, ExportedGraph] = {}
    for name, found in export_graphs(graph or list(GRAPHS), settings, sizes):
        files |= found
        if not quiet:
            checks = "; ".join(
                f"{c.off:.1e} {c.unit} off, {c.limit:g} allowed" for c in next(iter(found.values())).checks
            )
            typer.echo(f"{name}: {', '.join(found)}: compared with torch: {checks}", err=True)
    write_graphs(out, files)
    if not quiet:
        for name, made in files.items():
            typer.echo(f"{out / name}: {len(made.content)} bytes")
        typer.echo(f"{out / 'manifest.json'}")


def size_of(text: str) -> tuple[int, int]:
    """(width, height) of `640x480`. Raises InputError for anything else."""
    width, _, height = text.lower().partition("x")
    if not (width.isdecimal() and height.isdecimal() and 64 <= int(width) <= 8192 and 64 <= int(height) <= 8192):
        raise InputError(
            f"--size is '{text}'; wanted width x height in pixels, from 64x64 to 8192x8192, such as 640x480"
        )
    return int(width), int(height)
