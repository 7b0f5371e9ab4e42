"""The command ``deckfix heave``."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

import click

if TYPE_CHECKING:
    from estimation.heave.model import Method


@click.command()
@click.argument("file", metavar="F.mcap|SERIES.csv")
@click.option(
    "-o", "--output", "--plot", "page", metavar="R.html", help="Write spectrum, fit and forecast as a page."
)
@click.option("--json", "json_path", metavar="S.json", help="Write the summary; - for standard output.")
@click.option(
    "--time", "time_column", metavar="COLUMN", help="Series: column of the time, by name or number."
)
@click.option("--heave", "heave_column", metavar="COLUMN", help="Series: column of the heave, positive up.")
@click.option("--sigma", metavar="COLUMN|M", help="Series: column of its 1 sigma, or metres (0.03).")
@click.option(
    "--rate", "rate_hz", type=float, metavar="HZ", help="Series: samples a second, where it has no time."
)
@click.option("--unit", type=click.Choice(["m", "cm", "mm", "ft"]), help="Series: unit of the heave.")
@click.option("--window", "window_s", type=float, default=120.0, show_default=True, metavar="S",
              help="Series: how much of the past a model is learned from.")  # fmt: skip
@click.option("--longest", "longest_s", type=float, default=None, metavar="S",
              help="Series: longest period of heave; slower is drift. Default: 33 s.")  # fmt: skip
@click.option("--method", type=click.Choice(["bhr", "sinusoids"]), default="bhr", show_default=True,
              help="Series: a learned spectrum, or a plain sum of sinusoids.")  # fmt: skip
@click.option("--components", type=click.IntRange(1, 20), default=3, show_default=True,
              help="Number of sinusoids.")  # fmt: skip
@click.option("--config", metavar="C.toml", help="Flight: the configuration to replay with.")
@click.option("--engine", type=click.Choice(["auto", "filterpy", "compiled"]), default="auto", show_default=True,
              help="Flight: the engine to replay with.")  # fmt: skip
@click.option("--force", is_flag=True, help="Overwrite output files that exist.")
def heave(
    file: str,
    page: str | None,
    json_path: str | None,
    time_column: str | None,
    heave_column: str | None,
    sigma: str | None,
    rate_hz: float | None,
    unit: str | None,
    window_s: float,
    longest_s: float | None,
    method: str,
    components: int,
    config: str | None,
    engine: str,
    force: bool,
) -> None:
    """Show how a deck heaves: components, spectrum, forecast, quiet windows.

    Takes a flight, whose vision fixes show the deck, or a series of time, heave and, if known, its sigma as text.
    Forecasts are held against what then happened.
    """
    from deckfix.heave_command import heave_of_flight, heave_of_series, is_log

    if is_log(file):
        if any(v is not None for v in (time_column, heave_column, sigma, rate_hz, unit, longest_s)):
            raise click.UsageError(
                "--time, --heave, --sigma, --rate, --unit and --longest are for a series, not a log"
            )
        click.echo(
            heave_of_flight(file, page=page, json_path=json_path, config=config, engine=engine, force=force)
        )
        return
    if config is not None:
        raise click.UsageError("--config is for a flight; this file is no MCAP log")
    from deckfix.backtest import Fitting
    from deckfix.heave_series import Choice
    from estimation.heave.spectrum import SpectrumSettings

    for name, value in (("--rate", rate_hz), ("--window", window_s), ("--longest", longest_s)):
        if value is not None and not 0.0 < value < 1e9:
            raise click.UsageError(f"{name}: {value:g} is not positive")
    settings = SpectrumSettings() if longest_s is None else SpectrumSettings(lowest_hz=1.0 / longest_s)
    if settings.lowest_hz >= 0.25 * settings.highest_hz:
        raise click.UsageError(
            f"--longest: periods are sought down to {1.0 / settings.highest_hz:.2f} s; give a longer one"
        )
    fitting = Fitting(window_s, cast("Method", method), components, settings)
    choice = Choice(time_column, heave_column, sigma, rate_hz, unit)
    click.echo(heave_of_series(file, choice, fitting, page=page, json_path=json_path, force=force))
