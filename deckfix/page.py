"""Pages of HTML that are complete in themselves, and into which text from a log goes as text only.

Text is escaped in the page as HTML and in the figures' data as JSON without ``<``, ``>`` and ``&``; a content
security policy lets only the page's own two scripts run and nothing be fetched.
"""

from __future__ import annotations

import base64
import hashlib
import html
import json
from collections.abc import Iterable, Sequence
from importlib import resources
from typing import Any

import numpy as np

from deckfix._version import __version__
from deckfix.plotting import Figure


def text(value: object) -> str:
    """Return text for HTML: escaped, control characters (other than line breaks) made visible."""
    clean = "".join(c if c.isprintable() or c in "\n\t" else "\N{REPLACEMENT CHARACTER}" for c in str(value))
    return html.escape(clean)


def embedded_json(value: Any) -> str:
    """Return JSON that may stand inside a ``<script>``: no ``<``, ``>``, ``&`` or line separators in it.

    NumPy arrays of float32 become plotly's typed arrays; other numbers that are not finite become null.
    """
    out = json.dumps(_plain(value), ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    return out.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        data = np.ascontiguousarray(value, dtype="<f4")
        return {"dtype": "f4", "bdata": base64.b64encode(data.tobytes()).decode("ascii")}
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, float | np.floating):
        return float(value) if np.isfinite(value) else None
    if isinstance(value, np.integer):
        return int(value)
    return value


class Plots:
    """The figures of a page: places in the body, data at its end."""

    def __init__(self) -> None:
        self.data: list[str] = []

    def place(self, figure: Figure, description: str) -> str:
        """Return the place of a figure, described in words for those who do not see it."""
        name = f"plot{len(self.data) + 1}"
        self.data.append(f'<script type="application/json" id="data-{name}">{embedded_json(figure)}</script>')
        height = int(figure["layout"]["height"])
        return (
            f'<div class="plot" id="{name}" role="img" aria-label="{text(description)}" '
            f'style="min-height:{height}px"></div>'
        )


def document(title: str, header: str, links: str, body: str, plots: Plots) -> str:
    """Return a whole page around a header, its links, the sections of its body, and their figures."""
    from plotly.offline import get_plotlyjs

    assets = resources.files("deckfix")
    style = (assets / "report.css").read_text(encoding="utf-8")
    own = (assets / "report.js").read_text(encoding="utf-8")
    library = get_plotlyjs()
    allowed = " ".join(f"'sha256-{_sha256(script)}'" for script in (library, own))
    policy = (
        f"default-src 'none'; script-src {allowed}; style-src 'unsafe-inline'; img-src data: blob:; "
        "base-uri 'none'; form-action 'none'"
    )
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f'<meta name="generator" content="deckfix {__version__}">'
        f"<title>{text(title)} - deckfix</title><style>{style}</style></head><body>"
        f"<nav><div><b>deckfix</b>{links}</div></nav><main>{header}"
        "<noscript><p>The plots need JavaScript; the tables do not.</p></noscript>"
        f"{body}<footer>Written by deckfix {__version__}. This page is complete in itself: it loads nothing "
        "and sends nothing.</footer></main>"
        f"{''.join(plots.data)}<script>{library}</script><script>{own}</script></body></html>\n"
    )


def _sha256(script: str) -> str:
    return base64.b64encode(hashlib.sha256(script.encode()).digest()).decode("ascii")


def table(
    heads: Sequence[str],
    rows: Iterable[tuple[str, Sequence[str]]],
    *,
    numeric: tuple[int, ...] = (),
    css: str = "",
) -> str:
    """Return a table of cells that are HTML already; each row comes with its CSS class."""

    def cell(tag: str, i: int, content: str) -> str:
        right = ' class="n"' if i in numeric else ""
        head = f' data-head="{text(heads[i])}"' if tag == "td" else ""
        return f"<{tag}{right}{head}>{content}</{tag}>"

    head = "".join(cell("th", i, h) for i, h in enumerate(heads))
    body = "".join(
        f'<tr class="{kind}">{"".join(cell("td", i, c) for i, c in enumerate(cells))}</tr>'
        for kind, cells in rows
    )
    whole = f'<table class="{css}"><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>'
    return f'<div class="scroll">{whole}</div>'
