"""The command ``tune``."""

from __future__ import annotations

from typing import Any

import click


@click.command()
@click.argument("files", nargs=-1, required=True, metavar="F.mcap...")
@click.option(
    "--holdout", "holdouts", multiple=True, metavar="G.mcap",
    help="A flight that decides and is not tuned on (may be repeated).",
)  # fmt: skip
@click.option("-o", "--output", required=True, metavar="C.toml", help="The configuration to write.")
@click.option(
    "--config", "config_path", metavar="C.toml",
    help="Configuration to start from (default: the logs' own, else built in).",
)  # fmt: skip
@click.option(
    "--parameters", multiple=True, metavar="NAME",
    help="What to tune: table.key, * for anything (may be repeated; default: the noises of the sensors there are).",
)  # fmt: skip
@click.option(
    "--bounds", multiple=True, metavar="NAME=LOW:HIGH",
    help="Bounds of a parameter (may be repeated; default: a factor of 100 either way).",
)  # fmt: skip
@click.option(
    "--truth", "truth_weight", type=click.FloatRange(min=0.0), default=0.0, show_default=True, metavar="WEIGHT",
    help="Count the errors against the log's truth as well, with this weight.",
)  # fmt: skip
@click.option(
    "--starts", type=click.IntRange(1, 100), default=2, show_default=True, metavar="N",
    help="Searches: from the configuration, and from places drawn about it.",
)  # fmt: skip
@click.option("--seed", type=int, default=1, show_default=True, help="Of these places.")
@click.option(
    "--engine", type=click.Choice(["auto", "filterpy", "compiled"]), default="auto", show_default=True,
    help="auto takes compiled where numba is installed.",
)  # fmt: skip
@click.option(
    "--jobs", type=click.IntRange(min=1), metavar="N", help="Processes (default: one for each core)."
)
@click.option("--scheduler", metavar="URL", help="Work on a Dask cluster instead: tcp://HOST:8786.")
@click.option("--force", is_flag=True, help="Overwrite the output, and the state of another tuning.")
def tune(
    files: tuple[str, ...], holdouts: tuple[str, ...], output: str, config_path: str | None,
    parameters: tuple[str, ...], bounds: tuple[str, ...], truth_weight: float, starts: int, seed: int,
    engine: str, jobs: int | None, scheduler: str | None, force: bool,
) -> None:  # fmt: skip
    """Find the noises under which the flights' measurements are likeliest, and write them as a configuration.

    Flights that are held out decide: what is worse there is not written. Interrupted, it goes on where it was.
    """
    from deckfix.tune import TuneOptions, run_tune

    chosen: Any = engine
    options = TuneOptions(
        config_path, parameters, bounds, truth_weight, starts, seed, chosen, jobs, scheduler, force
    )
    text, written = run_tune(files, holdouts, output, options)
    click.echo(text)
    if not written:
        raise SystemExit(1)
