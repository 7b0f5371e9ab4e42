"""The command ``deckfix onboard``."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

import click

if TYPE_CHECKING:
    from estimation.estimator import EngineName


@click.command()
@click.option(
    "--mavlink", required=True, metavar="URL",
    help="udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT or serial:/dev/NAME:BAUD.",
)  # fmt: skip
@click.option("--camera", metavar="SRC", help="Device number, file, URL or GStreamer pipeline.")
@click.option("--config", "config_path", metavar="C.toml", help="Configuration; [onboard] names the files.")
@click.option("--calibration", metavar="C.toml", help="The camera's file.  [default: the configuration's]")
@click.option("--target", metavar="T.toml", help="The target's file.  [default: the configuration's]")
@click.option(
    "--record", metavar="DIR|F.mcap", help="Record the flight; a folder gets a file named by the time."
)
@click.option(
    "--publish", default="landing_target", show_default=True, metavar="WHAT",
    help="landing_target, odometry, both with a comma, or none.",
)  # fmt: skip
@click.option("--guide", is_flag=True, help="Send velocity set-points while the autopilot is in GUIDED.")
@click.option(
    "--system", type=click.IntRange(0, 255), default=0, metavar="N", help="Listen to this system only."
)
@click.option(
    "--signing-key", metavar="FILE", help="MAVLink signing: a key or passphrase; unsigned is refused."
)
@click.option(
    "--foxglove", is_flag=False, flag_value="127.0.0.1:8765", metavar="[HOST:PORT]",
    help="Serve live topics to Foxglove (on the loopback alone unless told otherwise).",
)  # fmt: skip
@click.option(
    "--engine", type=click.Choice(["auto", "filterpy", "compiled"]), default="auto", show_default=True,
    help="auto takes compiled where numba is installed.",
)  # fmt: skip
@click.option(
    "--wait", default=10.0, show_default=True, metavar="S", help="How long to wait for the autopilot."
)
@click.option(
    "--seconds", type=float, metavar="S", help="End after so long.  [default: at SIGTERM or Ctrl-C]"
)
@click.option("--plain", is_flag=True, help="Lines instead of the dashboard.")
def onboard(
    mavlink: str,
    camera: str | None,
    config_path: str | None,
    calibration: str | None,
    target: str | None,
    record: str | None,
    publish: str,
    guide: bool,
    system: int,
    signing_key: str | None,
    foxglove: str | None,
    engine: str,
    wait: float,
    seconds: float | None,
    plain: bool,
) -> None:
    """Estimate live, beside an autopilot: tell it where the deck is, and record what was seen."""
    from deckfix.dashboard import show
    from deckfix.flight_file import load_flight_file
    from deckfix.launch import Options, fly, prepare
    from deckfix.launch import signing_key as key_of

    setup = load_flight_file(config_path, camera=calibration, target=target)
    key = None if signing_key is None else key_of(signing_key)
    wanted = tuple(p.strip() for p in publish.split(",") if p.strip() not in ("", "none"))
    options = Options(mavlink, camera, record, wanted, guide, system, key, cast("EngineName", engine), wait)
    server = None
    if foxglove is not None:
        from deckfix.viewer import Viewer

        server = Viewer.listen(foxglove)
        _say(f"Foxglove: open {server.url}, and the layout {server.layout_path()}")
    try:
        flight = prepare(options, setup, _say)
        if server is not None:
            server.begin(flight)
        if flight.recorder is not None:
            _say(f"recording to {flight.recorder.path}")
        shown = show(lambda: flight.status, flight.stop, _say, plain=plain)
        fly(flight, seconds)
        shown.join(1.0)
    finally:
        if server is not None:
            server.close()
    for text in summary_lines(flight):
        _say(text)


def summary_lines(flight: object) -> list[str]:
    """Return what there is to say at the end."""
    from deckfix.onboard import Onboard

    assert isinstance(flight, Onboard)
    c = flight.counts
    lines = [
        f"{c['estimates']} estimates, {c['images']} images, {c['fixes']} fixes, {c['fused fixes']} fused, "
        f"{flight.link.sent['LANDING_TARGET']} LANDING_TARGET sent",
        f"{flight.latency_words()}; {flight.load.words}",
    ]
    turned = {**flight.link.counts, **flight.link.sensors.counts_turned_away}
    if turned:
        lines.append("turned away: " + ", ".join(f"{n} {k}" for k, n in sorted(turned.items())))
    if flight.recorder is not None:
        r = flight.recorder
        lost = ", ".join(f"{n} {k}" for k, n in sorted(r.drops.items()))
        lines.append(r.failed or f"wrote {r.path}" + (f" (not written: {lost})" if lost else ""))
    return lines


def _say(text: str) -> None:
    from deckfix.terminal import printable

    click.echo(printable(text))
