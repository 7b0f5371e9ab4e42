"""The command ``deckfix sync``: clocks and the camera's latency from a whole flight."""

from __future__ import annotations

import click


@click.command()
@click.argument("file", metavar="F.mcap")
@click.option(
    "--config", "config_path", metavar="C.toml", help="Configuration (default: the log's own, else built in)."
)
@click.option(
    "--write", "write_path", metavar="CONFIG.toml", help="Write the configuration with the latency found."
)
@click.option("--json", "json_path", metavar="S.json", help="Write the result; - for standard output.")
@click.option(
    "--arrivals", is_flag=True, help="Throw the fixes' own stamps away: latency against their arrivals."
)
@click.option(
    "--jobs", type=click.IntRange(1, 64), metavar="N", help="Replays at a time (default: one a processor)."
)
@click.option(
    "--engine", type=click.Choice(["auto", "filterpy", "compiled"]), default="auto", show_default=True,
    help="auto takes compiled where numba is installed.",
)  # fmt: skip
@click.option("--force", is_flag=True, help="Overwrite output files that exist.")
def sync(
    file: str,
    config_path: str | None,
    write_path: str | None,
    json_path: str | None,
    arrivals: bool,
    jobs: int | None,
    engine: str,
    force: bool,
) -> None:
    """Find the latency of a log's vision fixes, and tell of its clocks.

    Replays the flight with many latencies and takes the likeliest. It is known well where the vehicle turned while it
    saw the target, and said to be unobservable where it did not.
    """
    from deckfix.sync_command import sync_command

    click.echo(
        sync_command(
            file, config=config_path, write=write_path, json_path=json_path, arrivals=arrivals, jobs=jobs,
            engine=engine, force=force,
        )
    )  # fmt: skip
