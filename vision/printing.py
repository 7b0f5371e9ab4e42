"""Targets on paper: SVG, PDF (tiled over sheets where it does not fit on one) and PNG, all to scale.

Every sheet says how large it is meant to be and carries a bar of 100 mm to hold a ruler against, because
printers scale to fit unless told not to.
"""

from __future__ import annotations

import math
import struct
import zlib
from xml.sax.saxutils import escape

import numpy as np

from vision.target import RingTarget

PAPERS_MM: dict[str, tuple[float, float]] = {
    "A4": (210.0, 297.0),
    "A3": (297.0, 420.0),
    "A2": (420.0, 594.0),
    "A1": (594.0, 841.0),
    "A0": (841.0, 1189.0),
    "letter": (215.9, 279.4),
}
"""Width and height of sheets [mm], upright."""

_MARGIN_MM = 10.0
_LABEL_MM = 14.0
_BAR_MM = 100.0
_POINTS_PER_MM = 72.0 / 25.4
_LARGEST_PIXELS = 100_000_000


def label(target: RingTarget) -> str:
    """Return the line that is printed with a target: its name and sizes."""
    return (
        f"{target.name}: outer diameter {target.diameter_m * 1e3:.1f} mm, "
        f"white board {target.side_m * 1e3:.1f} mm square"
    )


def to_svg(target: RingTarget) -> str:
    """Return the target as SVG in millimetres, true to scale, with its size and a 100 mm bar below it."""
    side = target.side_m * 1e3
    bar = min(_BAR_MM, 0.5 * side)
    text = min(5.0, side / 45.0)
    width, height = side + 2.0, side + 2.0 + 4.0 * text
    middle = 1.0 + side / 2.0
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:.4f}mm" height="{height:.4f}mm" '
        f'viewBox="0 0 {width:.4f} {height:.4f}">',
        f"<title>{escape(label(target))}</title>",
        f'<rect x="1" y="1" width="{side:.4f}" height="{side:.4f}" fill="rgb{target.white_rgb}" '
        'stroke="black" stroke-width="0.1"/>',
    ]
    for k, radius in enumerate(target.edges_m):
        colour = target.red_rgb if k % 2 == 0 else target.white_rgb
        lines.append(
            f'<circle cx="{middle:.4f}" cy="{middle:.4f}" r="{radius * 1e3:.4f}" fill="rgb{colour}"/>'
        )
    base = side + 1.0 + 1.6 * text
    lines += [
        f'<text x="1" y="{base:.3f}" font-family="sans-serif" font-size="{text:.3f}">'
        f"{escape(label(target))}</text>",
        f'<path d="M 1 {base + text:.3f} h {bar:.4f}" stroke="black" stroke-width="0.3"/>',
        f'<text x="{bar + 2.0:.3f}" y="{base + 1.3 * text:.3f}" font-family="sans-serif" '
        f'font-size="{text:.3f}">this bar is {bar:.1f} mm: print at 100 %</text>',
        "</svg>",
    ]
    return "\n".join(lines) + "\n"


def to_pdf(target: RingTarget, paper: str = "A4") -> bytes:
    """Return the target as PDF at 100 %, on one sheet or tiled over as many as it takes.

    Tiles abut at crop marks; a sheet's label says its row and column. Sheets that would be white all over are
    left out. ``ValueError`` for an unknown paper, or more than 400 sheets.
    """
    if paper not in PAPERS_MM:
        raise ValueError(f"paper: no sheet {paper!r}; there are {', '.join(PAPERS_MM)}")
    sheet = PAPERS_MM[paper]
    tile = (sheet[0] - 2.0 * _MARGIN_MM, sheet[1] - 2.0 * _MARGIN_MM - _LABEL_MM)
    side = target.side_m * 1e3
    columns, rows = (max(1, math.ceil(side / extent - 1e-9)) for extent in tile)
    if columns * rows > 400:
        raise ValueError(
            f"paper: {columns * rows} sheets of {paper}; choose a larger one, or send the SVG to a print shop"
        )
    radius = target.edges_m[0] * 1e3
    pages = []
    for row in range(rows):
        for column in range(columns):
            left, top = column * tile[0] - side / 2.0, row * tile[1] - side / 2.0
            aside, above = max(left, -(left + tile[0]), 0.0), max(top, -(top + tile[1]), 0.0)
            near = math.hypot(aside, above)
            if near < radius:
                name = f"sheet: row {row + 1} of {rows}, column {column + 1} of {columns}"
                pages.append(_page(target, sheet, tile, (left, top), name if rows * columns > 1 else ""))
    return _document(pages, sheet)


def to_png(target: RingTarget, dpi: float = 300.0) -> bytes:
    """Return the white board as PNG with its resolution in the file, so that it prints to scale.

    ``ValueError`` for a resolution that is not positive or a picture above 100 megapixels.
    """
    import cv2

    if not (math.isfinite(dpi) and dpi > 0.0):
        raise ValueError(f"dpi: {dpi!r} is not a positive resolution")
    per_metre = dpi / 0.0254
    pixels = max(2, round(target.side_m * per_metre))
    if pixels * pixels > _LARGEST_PIXELS:
        most = math.floor(math.sqrt(_LARGEST_PIXELS) / target.side_m * 0.0254)
        raise ValueError(
            f"dpi: {pixels}x{pixels} pixels at {dpi:g} dpi; at most {most} dpi, or write SVG or PDF"
        )
    along = np.arange(pixels, dtype=np.float32) - np.float32((pixels - 1) / 2.0)
    rho = np.sqrt(along[:, None] ** 2 + along[None, :] ** 2)
    share = np.zeros_like(rho)
    for k, radius in enumerate(target.edges_m):
        share += np.float32(1 - 2 * (k % 2)) * np.clip(np.float32(radius * per_metre) - rho + 0.5, 0.0, 1.0)
    white, red = (np.array(c[::-1], dtype=np.float32) for c in (target.white_rgb, target.red_rgb))
    image = np.rint(white + share[..., None] * (red - white)).astype(np.uint8)
    done, encoded = cv2.imencode(".png", image)
    if not done:
        raise RuntimeError("the picture could not be encoded as PNG")
    data = bytes(encoded)
    body = b"pHYs" + struct.pack(">IIB", round(per_metre), round(per_metre), 1)
    chunk = struct.pack(">I", len(body) - 4) + body + struct.pack(">I", zlib.crc32(body))
    return data[:33] + chunk + data[33:]  # after the signature (8 bytes) and the header chunk (25)


def _circle(radius_mm: float) -> str:
    """Return PDF operators for a circle around the origin: eight Bezier arcs, true to 5e-6 of the radius."""
    arcs = 8
    step = 2.0 * math.pi / arcs
    handle = 4.0 / 3.0 * math.tan(step / 4.0)
    parts = [f"{radius_mm:.5f} 0 m"]
    for k in range(arcs):
        c0, s0 = math.cos(k * step), math.sin(k * step)
        c1, s1 = math.cos((k + 1) * step), math.sin((k + 1) * step)
        points = (c0 - handle * s0, s0 + handle * c0, c1 + handle * s1, s1 - handle * c1, c1, s1)
        parts.append(" ".join(f"{radius_mm * p:.5f}" for p in points) + " c")
    return "\n".join([*parts, "h"])


def _page(
    target: RingTarget,
    sheet: tuple[float, float],
    tile: tuple[float, float],
    corner: tuple[float, float],
    name: str,
) -> str:
    """Return one sheet's drawing in PDF operators; ``corner`` is the tile's upper left, from the target's
    centre [mm].
    """
    side = target.side_m * 1e3
    x0, y1 = _MARGIN_MM, sheet[1] - _MARGIN_MM  # upper left of the tile on the sheet, y upwards from here on
    if not name:
        x0, y1 = x0 + (tile[0] - side) / 2.0, y1 - (tile[1] - side) / 2.0
    extent = tile if name else (side, side)
    x1, y0 = x0 + extent[0], y1 - extent[1]
    centre = (x0 - (corner[0] if name else -side / 2.0), y1 + (corner[1] if name else -side / 2.0))
    paint = ["q", f"{_POINTS_PER_MM:.8f} 0 0 {_POINTS_PER_MM:.8f} 0 0 cm"]
    paint += [
        "q",
        f"{x0:.4f} {y0:.4f} {extent[0]:.4f} {extent[1]:.4f} re W n",
        f"1 0 0 1 {centre[0]:.5f} {centre[1]:.5f} cm",
    ]
    paint += [_colour(target.red_rgb)]
    for outer, inner in target.red_bands_m:
        paint += [_circle(outer * 1e3), *([_circle(inner * 1e3)] if inner > 0.0 else []), "f*"]
    paint += ["0 G 0.1 w", f"{-side / 2:.4f} {-side / 2:.4f} {side:.4f} {side:.4f} re S", "Q", "0 G 0.15 w"]
    for x, out_x in ((x0, -1.0), (x1, 1.0)):
        for y, out_y in ((y0, -1.0), (y1, 1.0)):
            paint.append(f"{x + 1.5 * out_x:.4f} {y:.4f} m {x + 6.0 * out_x:.4f} {y:.4f} l S")
            paint.append(f"{x:.4f} {y + 1.5 * out_y:.4f} m {x:.4f} {y + 6.0 * out_y:.4f} l S")
    foot = _MARGIN_MM + 1.0
    paint.append(f"0.4 w {_MARGIN_MM + 2:.4f} {foot:.4f} m {_MARGIN_MM + 2 + _BAR_MM:.4f} {foot:.4f} l S 0 g")
    paint.append(
        _text(f"this bar is {_BAR_MM:.0f} mm: print at 100 %", _MARGIN_MM + _BAR_MM + 5.0, foot - 1.0)
    )
    paint.append(_text(label(target) + (f"; {name}" if name else ""), _MARGIN_MM + 2.0, foot + 3.0))
    return "\n".join([*paint, "Q"])


def _colour(rgb: tuple[int, int, int]) -> str:
    """Return the PDF operator that sets the filling colour."""
    return " ".join(f"{c / 255.0:.4f}" for c in rgb) + " rg"


def _text(line: str, x_mm: float, y_mm: float) -> str:
    """Return PDF operators for a line of text, 3 mm high; what WinAnsi does not have becomes a question
    mark.
    """
    safe = line.replace("\\", "\\\\").replace("(", "\\(").replace(")", "\\)")
    safe = "".join(c if 32 <= ord(c) < 127 else "?" for c in safe)
    return f"BT /F1 3 Tf {x_mm:.4f} {y_mm:.4f} Td ({safe}) Tj ET"


def _document(pages: list[str], sheet: tuple[float, float]) -> bytes:
    """Return a PDF file of pages of one size."""
    box = " ".join(f"{extent * _POINTS_PER_MM:.4f}" for extent in sheet)
    kids = " ".join(f"{4 + 2 * k} 0 R" for k in range(len(pages)))
    objects = [
        "<< /Type /Catalog /Pages 2 0 R >>",
        f"<< /Type /Pages /Kids [{kids}] /Count {len(pages)} /MediaBox [0 0 {box}] >>",
        "<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica /Encoding /WinAnsiEncoding >>",
    ]
    for k, page in enumerate(pages):
        objects.append(
            "<< /Type /Page /Parent 2 0 R /Resources << /Font << /F1 3 0 R >> >> "
            f"/Contents {5 + 2 * k} 0 R >>"
        )
        objects.append(f"<< /Length {len(page.encode('ascii'))} >>\nstream\n{page}\nendstream")
    out = bytearray(b"%PDF-1.4\n")
    offsets = []
    for number, content in enumerate(objects, start=1):
        offsets.append(len(out))
        out += f"{number} 0 obj\n{content}\nendobj\n".encode("ascii")
    start = len(out)
    table = "".join(f"{offset:010d} 00000 n \n" for offset in offsets)
    out += f"xref\n0 {len(objects) + 1}\n0000000000 65535 f \n{table}".encode("ascii")
    out += f"trailer\n<< /Size {len(objects) + 1} /Root 1 0 R >>\nstartxref\n{start}\n%%EOF\n".encode("ascii")
    return bytes(out)
