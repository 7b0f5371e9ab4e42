"""The commands that prepare seeing: ``deckfix target`` prints one, ``deckfix calibrate`` measures the
camera.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from vision.calibrate import Charuco, Chessboard
    from vision.target import RingTarget

_PAPERS = ("A4", "A3", "A2", "A1", "A0", "letter")


@click.command()
@click.argument("file", required=False, metavar="[T.toml]")
@click.option("-o", "--output", required=True, metavar="T.svg|.pdf|.png|.toml", help="The drawing to write.")
@click.option(
    "--kind", type=click.Choice(["recommended", "thesis"]), default=None, help="Without T.toml: which rings."
)
@click.option(
    "--diameter", type=float, default=None, metavar="M", help="Without T.toml: outer diameter in metres."
)
@click.option("--paper", type=click.Choice(_PAPERS), default="A4", show_default=True, help="Sheets of a PDF.")
@click.option("--dpi", type=float, default=300.0, show_default=True, help="Resolution of a PNG.")
@click.option("--force", is_flag=True, help="Overwrite output files that exist.")
def target(
    file: str | None,
    output: str,
    kind: str | None,
    diameter: float | None,
    paper: str,
    dpi: float,
    force: bool,
) -> None:
    """Draw a target to scale, and write the target.toml that goes with it.

    Takes the rings from T.toml, or makes the recommended target (1 m) or the thesis's (0.21 m) of any
    diameter. A PDF is tiled over as many sheets as it takes; print at 100 % and measure the bar.
    """
    from deckfix.files import InputError, OutputError, check_output, existing, output_file
    from vision.printing import label, to_pdf, to_png, to_svg
    from vision.target import RingTarget

    suffix = Path(output).suffix.lower()
    if suffix not in (".svg", ".pdf", ".png", ".toml"):
        raise OutputError(f"{output}: cannot tell what to draw; end the name in .svg, .pdf, .png or .toml")
    if file is not None and (kind is not None or diameter is not None):
        raise click.UsageError("T.toml says what the target is; leave out --kind and --diameter")
    try:
        rings = RingTarget.load(existing(file)) if file is not None else _made(kind, diameter)
    except InputError:
        raise
    except ValueError as error:
        what = str(error) if file is not None else f"--diameter: {error}; give metres"
        raise InputError(what) from error
    inputs = () if file is None else (file,)
    notes = Path(output).with_suffix(".toml")
    check_output(output, force=force, inputs=inputs)
    if file is None:
        check_output(notes, force=force)
    if suffix != ".toml":
        try:
            if suffix == ".svg":
                drawing = to_svg(rings).encode("utf-8")
            else:
                drawing = to_pdf(rings, paper) if suffix == ".pdf" else to_png(rings, dpi)
        except ValueError as error:
            raise OutputError(f"{output}: {error}") from error
        with output_file(output, force=force, inputs=inputs) as partial:
            partial.write_bytes(drawing)
        click.echo(f"{output}: {label(rings)}")
    if file is None or suffix == ".toml":
        with output_file(notes, force=force, inputs=inputs) as partial:
            partial.write_text(rings.to_toml(), encoding="utf-8")
        click.echo(f"{notes}: edge radii; correct them to what the print measures")


def _made(kind: str | None, diameter: float | None) -> RingTarget:
    """Return a target of a kind and diameter [m], each with its default."""
    from vision.target import RingTarget

    make = RingTarget.thesis if kind == "thesis" else RingTarget.recommended
    return make() if diameter is None else make(diameter)


def _size(ctx: click.Context, option: click.Parameter, value: str) -> tuple[int, int]:
    """Return (columns, rows) of a text such as 9x6."""
    columns, _, rows = value.lower().partition("x")
    if not (columns.isdecimal() and rows.isdecimal()):
        raise click.BadParameter(f"{value!r} is not of the form 9x6", ctx, option)
    return int(columns), int(rows)


@click.command()
@click.argument("files", nargs=-1, required=True, metavar="IMAGE...")
@click.option("-o", "--output", required=True, metavar="camera.toml", help="The camera file to write.")
@click.option(
    "--board", type=click.Choice(["chessboard", "charuco"]), default="chessboard", show_default=True
)
@click.option(
    "--size", default="9x6", callback=_size, show_default=True, metavar="CxR",
    help="INNER corners of a chessboard; SQUARES of a ChArUco board.",
)  # fmt: skip
@click.option("--square-mm", type=float, default=25.0, show_default=True, help="Side of a square.")
@click.option(
    "--marker-mm", type=float, default=None, help="ChArUco: side of a marker.  [default: 0.75 squares]"
)
@click.option("--dictionary", default="DICT_4X4_50", show_default=True, help="ChArUco: its markers.")
@click.option(
    "--readout-ms", type=float, default=0.0, show_default=True, help="Read-out time of a rolling shutter."
)
@click.option("--coverage", metavar="C.png", help="Write a picture of where in the image there were corners.")
@click.option("--force", is_flag=True, help="Overwrite output files that exist.")
def calibrate(
    files: tuple[str, ...],
    output: str,
    board: str,
    size: tuple[int, int],
    square_mm: float,
    marker_mm: float | None,
    dictionary: str,
    readout_ms: float,
    coverage: str | None,
    force: bool,
) -> None:
    """Measure a camera from pictures of a board, and say how well it is known.

    Take 15 or more sharp pictures in the mode that will fly, the board tilted both ways by 30 to 45 degrees
    and reaching into every corner of the image.
    """
    import cv2

    from deckfix.files import InputError, OutputError, check_output, output_file
    from vision.calibrate import calibrate as solve
    from vision.calibrate import coverage_picture

    outputs = [output] if coverage is None else [output, coverage]
    for path in outputs:
        check_output(path, force=force, inputs=files)
    if coverage is not None and Path(coverage).suffix.lower() not in (".png", ".jpg", ".jpeg"):
        raise OutputError(f"{coverage}: cannot tell what to draw; end the name in .png or .jpg")
    try:
        result = solve(
            _pictures(files), _board(board, size, square_mm, marker_mm, dictionary), readout_ms * 1e-3
        )
    except InputError:
        raise
    except ValueError as error:
        raise InputError(f"calibrate: {error}") from error
    with output_file(output, force=force, inputs=files) as partial:
        notes = "".join(f"# {line}\n" for line in result.summary().splitlines())
        partial.write_text(result.camera.to_toml() + notes, encoding="utf-8")
    click.echo(result.summary())
    click.echo(f"{output}: written")
    if coverage is not None:
        with output_file(coverage, force=force, inputs=files) as partial:
            cv2.imwrite(str(partial), coverage_picture(result))
        click.echo(f"{coverage}: written")


def _board(
    kind: str, size: tuple[int, int], square_mm: float, marker_mm: float | None, dictionary: str
) -> Chessboard | Charuco:
    """Return the board that the options describe."""
    from vision.calibrate import Charuco, Chessboard

    if kind == "chessboard":
        return Chessboard(*size, square_mm * 1e-3)
    marker = 0.75 * square_mm if marker_mm is None else marker_mm
    return Charuco(*size, square_mm * 1e-3, marker * 1e-3, dictionary)


def _pictures(files: tuple[str, ...]) -> Iterator[tuple[str, Any]]:
    """Yield name and picture of each file; ``InputError`` names the one that is not a picture."""
    import cv2

    from deckfix.files import InputError, existing

    for file in files:
        image = cv2.imread(str(existing(file)), cv2.IMREAD_COLOR)
        if image is None:
            raise InputError(f"{file}: not a picture that can be read; leave it out")
        yield file, image
