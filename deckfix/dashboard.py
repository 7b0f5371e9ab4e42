"""What the terminal shows of a flight on board: a dashboard, or a line every two seconds in a pipe."""

from __future__ import annotations

import math
import sys
import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from deckfix.terminal import printable

if TYPE_CHECKING:
    from deckfix.onboard import Status

REFRESH_S = 0.25
LINE_S = 2.0


def rows(status: Status) -> list[tuple[str, str]]:
    """Return the dashboard's rows: a name and what is to be said of it."""
    link = "alive" if status.link_alive else "LOST"
    out = [
        ("health", status.words),
        ("autopilot", f"{status.mode}{', armed' if status.armed else ''}, link {link}"),
    ]
    if status.guidance:
        out.append(("guidance", status.guidance))
    out.append(("LANDING_TARGET", status.publishing or "sent"))
    out += _place(status)
    for c in status.clocks:
        drift = f"{c.skew_ppm:+.1f} ppm" if math.isfinite(c.skew_ppm) else "skew unknown"
        out.append(
            (
                f"clock {c.clock}",
                f"{c.offset_ns * 1e-6:+.2f} ms \u00b1 {c.sigma_ns * 1e-6:.2f}, {drift}, {c.status}",
            )
        )
    out.append(("rates", ", ".join(f"{n} {r:.0f}/s" for n, r in sorted(status.rates_hz.items())) or "-"))
    out.append(("latency", _latency(status)))
    if status.log:
        out.append(("log", status.log))
    out.append(("drops", _counted(status.drops)))
    out.append(("turned away", _counted(status.turned_away)))
    return out


def line(status: Status) -> str:
    """Return a moment as one plain line."""
    parts = [status.words, f"{status.mode}{' armed' if status.armed else ''}"]
    if status.guidance:
        parts.append(status.guidance)
    parts += [f"{name} {text}" for name, text in _place(status)[:2]]
    parts.append(f"LANDING_TARGET {status.publishing or 'sent'}")
    parts.append(f"latency {_latency(status)}")
    if status.drops:
        parts.append(f"drops {_counted(status.drops)}")
    if any(name.startswith("log ") for name in status.drops):
        parts.append(status.log)
    return printable(" | ".join(parts))


def _place(status: Status) -> list[tuple[str, str]]:
    if status.newest is None or not len(status.newest.estimate.deck):
        return []
    e = status.newest.estimate
    sigma = np.sqrt(np.diag(e.deck_covariance))
    place = " ".join(
        f"{axis} {v:+.2f}\u00b1{s:.2f}" for axis, v, s in zip("NED", e.deck[:3], sigma, strict=False)
    )
    age = status.newest.seen_age_s(status.at_ns)
    seen = f"target seen {age:.1f} s ago" if math.isfinite(age) else "target never seen"
    deck = f"height {e.deck[6]:+.2f}\u00b1{sigma[6]:.2f} m, rate {e.deck[7]:+.2f}\u00b1{sigma[7]:.2f} m/s"
    return [("P_rel", f"{place} m, {seen}"), ("deck", deck)]


def _latency(status: Status) -> str:
    middle, high = status.latency_ms
    return f"median {middle:.0f} ms, p95 {high:.0f} ms" if math.isfinite(middle) else "-"


def _counted(counts: dict[str, int]) -> str:
    return ", ".join(f"{name} {n}" for name, n in sorted(counts.items()) if n) or "none"


def show(
    status: Callable[[], Status | None],
    stop: threading.Event,
    say: Callable[[str], None],
    *,
    plain: bool = False,
) -> threading.Thread:
    """Show what ``status`` gives until ``stop`` is set, in a thread that nobody waits for in flight."""
    live = sys.stdout.isatty() and not plain
    target, arguments = (_dashboard, (status, stop)) if live else (_lines, (status, stop, say))
    thread = threading.Thread(target=target, args=arguments, name="terminal", daemon=True)
    thread.start()
    return thread


def _lines(status: Callable[[], Status | None], stop: threading.Event, say: Callable[[str], None]) -> None:
    while not stop.wait(LINE_S):
        now = status()
        if now is not None:
            try:
                say(line(now))
            except (BrokenPipeError, ValueError):
                return  # nobody reads any more; the flight goes on


def _dashboard(status: Callable[[], Status | None], stop: threading.Event) -> None:
    from rich.live import Live

    with Live(refresh_per_second=4, transient=False) as screen:
        while not stop.wait(REFRESH_S):
            now = status()
            if now is not None:
                screen.update(_table(now))


def _table(status: Status) -> Any:
    from rich.markup import escape
    from rich.panel import Panel
    from rich.table import Table

    table = Table.grid(padding=(0, 2))
    for name, text in rows(status):
        table.add_row(f"[bold]{escape(name)}[/bold]", escape(printable(text)))
    return Panel(table, title="deckfix onboard", border_style="green" if status.state == 4 else "yellow")
