"""Commands for measured fields: export, gauges, animation."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from modeharvest.cli.messages import bars, folder_option
from modeharvest.util.errors import InputError

Run = Annotated[Path, typer.Argument(metavar="DIR", help="A run's folder, or a file of it.")]
_FORMATS = (
    "ncorr, vic2d, davis, dice, matchid, gom, aramis, pyvale, csv, mat, npz; runs: hdf5, vtu, tiff"
)


def export(
    source: Annotated[
        Path, typer.Argument(metavar="SOURCE", help="A run's folder, or any DIC code's field.")
    ],
    form: Annotated[str, typer.Option("--as", help=_FORMATS, metavar="FORMAT")],
    out: Annotated[Path, folder_option("--out", "Folder for the files.")],
    step: Annotated[int, typer.Option(help="Point spacing of codes' files, px.", min=1)] = 5,
    image: Annotated[
        Path | None, typer.Option(help="Reference image, for another code's field in pixels.")
    ] = None,
    pixel_size: Annotated[
        float | None, typer.Option(help="Pixel size, mm, of what was measured in pixels.")
    ] = None,
) -> None:
    """Write measured displacements in another DIC code's format, or with all derived fields.

    Other codes' fields are recognised and converted; the conventions found are printed.
    """
    from modeharvest.idic.local.export import convert
    from modeharvest.idic.photograph.finished import FinishedRun

    if source.is_dir() or source.suffix in (".h5", ""):
        if image:
            raise InputError("expected --image for other codes' fields alone")
        finished = FinishedRun.read(source, correlations=True)
        written = finished.export(form, out, step, pixel_size)
    else:
        path, field = convert(source, out, form, image, pixel_size)
        written = [path]
        print(field.read_as)
    files = "1 file" if len(written) == 1 else f"{len(written)} files"
    print(f"{files} in {out}, the first is {written[0].name}")


def gauges(
    run: Run,
    file: Annotated[Path, typer.Argument(metavar="GAUGES.toml", help="A table for each gauge.")],
) -> None:
    """Read gauges in every image of a run: DIR/gauges.csv, gauges_along.csv, gauges.pdf."""
    from modeharvest.idic.photograph.finished import FinishedRun
    from modeharvest.idic.photograph.gauges import along_axes, read_gauges, write_gauges
    from modeharvest.report.figures.on_photographs import draw_gauge, write_pdf

    finished = FinishedRun.read(run)
    wanted = along_axes(read_gauges(file), finished.angle)
    out = run if run.is_dir() else run.parent
    each = ((name, finished.result(name)) for name in finished.files)
    read = write_gauges(out, wanted, each, finished.unit)
    last, rows = [*read][-1], [["gauge", "reads", "value", "standard deviation"]]
    rows += [[name, what.replace("_", " "), f"{value:.6g} {unit}".rstrip(" -"), f"± {sd:.2g}"]
             for name, found in read[last].items()
             for what, (value, sd, unit) in found.items()]  # fmt: skip
    pages = [partial(draw_gauge, g.name, [r[g.name] for r in read.values()]) for g in wanted]
    write_pdf(out / "gauges.pdf", f"Gauges of {out.name} in {last}", rows, pages)
    print("\n".join("".join(map("{:<22}".format, row)).rstrip() for row in rows))
    print(f"{out / 'gauges.csv'}, gauges.pdf; images: {len(read)}")


def animate(
    run: Run,
    field: Annotated[
        list[str] | None,
        typer.Option(help="u, v, logarithmic_xx, rotation, stretch_1, ...; u by default."),
    ] = None,
    form: Annotated[str, typer.Option("--as", help="gif, mp4, or pdf of all fields.")] = "gif",
    photograph: Annotated[
        list[Path] | None, typer.Option(help="The photographs, in order, if they were moved.")
    ] = None,
) -> None:
    """Draw fields on the deformed photographs of a run: DIR/FIELD.gif, FIELD.mp4, fields.pdf."""
    from modeharvest.idic.photograph.finished import FinishedRun
    from modeharvest.report.figures import on_photographs

    if form not in ("gif", "mp4", "pdf"):
        raise InputError(f"expected --as gif, mp4 or pdf, got {form!r}")
    finished, out = FinishedRun.read(run, photograph or ()), run if run.is_dir() else run.parent
    names = field or (on_photographs.PRINTED if form == "pdf" else ("u",))
    with bars() as progress:
        if form == "pdf":
            on_photographs.print_fields(finished, names, out / "fields.pdf", progress)
        for name in names if form != "pdf" else ():
            on_photographs.animate(finished, name, out / f"{name}.{form}", progress)
    print(f"{out}: {', '.join(names)} as {form}")
