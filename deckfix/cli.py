"""The command ``deckfix``. Each command imports what it needs when it runs, so that ``--help`` answers at
once.

Errors are one line on stderr, ``deckfix: FILE: what is wrong; what to do``; the exit code is 1, or 2 where
the command line itself is wrong, 130 after Ctrl-C.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Sequence
from types import FrameType
from typing import Any

import click

from deckfix._version import __version__
from deckfix.cli_detect import detect
from deckfix.cli_heave import heave
from deckfix.cli_onboard import onboard
from deckfix.cli_sync import sync
from deckfix.cli_tune import tune
from deckfix.cli_vision import calibrate, target

# The matrices here are small: threads of the linear algebra library only wait for each other. It reads this when
# numpy is first imported, which no module above does.
for _variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")

_ENGINE = click.option(
    "--engine", type=click.Choice(["auto", "filterpy", "compiled"]), default="auto", show_default=True,
    help="auto takes compiled where numba is installed.",
)  # fmt: skip
_JOBS = click.option(
    "--jobs",
    type=click.IntRange(min=1),
    metavar="N",
    help="Processes on this machine (default: one for each core).",
)
_SCHEDULER = click.option(
    "--scheduler",
    metavar="URL",
    help="Work on a Dask cluster instead: the address of its scheduler, tcp://HOST:8786.",
)
_FORCE = click.option("--force", is_flag=True, help="Overwrite output files that exist.")


_ORDER = (
    "demo",
    "simulate",
    "import",
    "info",
    "replay",
    "report",
    "export",
    "heave",
    "detect",
    "target",
    "calibrate",
    "sync",
    "tune",
    "fleet",
)


class _Ordered(click.Group):
    """A group that lists its commands in the order in which they are used, the rest as they were added."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names of the commands."""
        return sorted(self.commands, key=lambda name: _ORDER.index(name) if name in _ORDER else len(_ORDER))


@click.group(
    cls=_Ordered,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
    epilog="Start with: deckfix demo",
)
@click.version_option(__version__, "-V", "--version", message="deckfix %(version)s")
def deckfix() -> None:
    """Estimate the state of a multirotor from its flight log, with honest uncertainty."""


@deckfix.command("import")
@click.argument("files", nargs=-1, required=True, metavar="FILE...")
@click.option("-o", "--output", required=True, metavar="F.mcap", help="The log to write.")
@click.option(
    "--system", type=int, metavar="N", help="MAVLink id of the vehicle, where a .tlog holds several."
)
@click.option("--video", metavar="V", help="The camera's recording: a video, or a folder of pictures.")
@click.option(
    "--stamps", metavar="S.csv", help="When each frame was taken: columns t_s (or t_ns), frame, clock."
)
@click.option(
    "--offset", "offset_s", metavar="S",
    help="What the frames' clock shows less the autopilot's [s]; t_flight = t_frame - S.",
)  # fmt: skip
@click.option("--camera", metavar="C.toml", help="The camera, as deckfix calibrate writes it.")
@click.option("--target", metavar="T.toml", help="The target, as deckfix target writes it.")
@_FORCE
def import_(
    files: tuple[str, ...], output: str, system: int | None, video: str | None, stamps: str | None,
    offset_s: str | None, camera: str | None, target: str | None, force: bool,
) -> None:  # fmt: skip
    """Turn flight logs into one MCAP log.

    Takes ArduPilot .BIN and .log, MAVLink .tlog and PX4 .ulg; an autopilot's log and the telemetry log of the
    same flight are joined by their clocks. What a camera saw can be added, to an MCAP log too: its video, its
    calibration, and the target.
    """
    from deckfix.importing import import_flight
    from deckfix.video_import import Extras

    extras = Extras.of(video, stamps, offset_s, camera, target)
    _say(import_flight(files, output, system=system, extras=extras, force=force))


@deckfix.command()
@click.argument("file", metavar="F.mcap")
def info(file: str) -> None:
    """Show what a log holds: topics, rates, gaps, clocks and what is wrong with it."""
    from deckfix.info import describe

    _say(describe(file))


@deckfix.command()
@click.argument("file", metavar="F.mcap")
@click.option("-o", "--output", metavar="OUT.mcap", help="Write sensors, estimates and fusion records.")
@click.option("--report", "report_path", metavar="R.html", help="Write the report.")
@click.option("--json", "json_path", metavar="S.json", help="Write the summary; - for standard output.")
@click.option(
    "--config", "config_path", metavar="C.toml", help="Configuration (default: the log's own, else built in)."
)
@_ENGINE
@click.option(
    "--check", is_flag=True, help="Replay twice and compare with recorded estimates: bytes must be equal."
)
@click.option(
    "--smooth", is_flag=True, help="Smooth as well: /smoothed topics, from what came before and after."
)
@click.option(
    "--images/--no-images",
    default=None,
    help="Look at the log's images for fixes; never.  [default: where the log holds no fixes]",
)
@_JOBS
@_FORCE
def replay(
    file: str,
    output: str | None,
    report_path: str | None,
    json_path: str | None,
    config_path: str | None,
    engine: str,
    check: bool,
    smooth: bool,
    images: bool | None,
    jobs: int | None,
    force: bool,
) -> None:
    """Run the estimator over a log.

    Its images become vision fixes where it carries the camera and the target (deckfix import --camera --target).
    """
    from deckfix.commands import replay_command

    text, equal = replay_command(
        file, output=output, report=report_path, json_path=json_path, config=config_path, engine=engine,
        check=check, force=force, smooth=smooth, images=images, jobs=jobs,
    )  # fmt: skip
    _say(text)
    if not equal:
        raise SystemExit(1)


@deckfix.command()
@click.argument("file", metavar="F.mcap")
@click.option("-o", "--output", required=True, metavar="R.html", help="The page to write.")
@_ENGINE
@_FORCE
def report(file: str, output: str, engine: str, force: bool) -> None:
    """Write the report of a flight as one HTML page.

    The log is replayed with its own configuration, or else the default one.
    """
    from deckfix.commands import report_command

    _say(report_command(file, output, engine=engine, force=force))


@deckfix.command()
@click.argument("file", metavar="F.mcap")
@click.option("-o", "--output", required=True, metavar="DIR", help="The folder to write to.")
@click.option(
    "--format", "kind", type=click.Choice(["csv", "npz", "parquet"]), default="csv", show_default=True,
    help="parquet needs pyarrow.",
)  # fmt: skip
@click.option("--topic", "topics", multiple=True, metavar="T", help="Only this topic (may be repeated).")
@_FORCE
def export(file: str, output: str, kind: str, topics: tuple[str, ...], force: bool) -> None:
    """Write the numeric topics of a log as tables, one file each."""
    from deckfix.export import export_flight

    _say(export_flight(file, output, kind=kind, topics=topics, force=force))


@deckfix.command()
@click.argument("file", metavar="F.mcap")
@click.option("-o", "--output", required=True, metavar="G.mcap", help="The log to write.")
@_FORCE
def recover(file: str, output: str, force: bool) -> None:
    """Copy all that is readable of a damaged log, and say what was lost."""
    from deckfix.importing import recover_flight

    _say(recover_flight(file, output, force=force))


@deckfix.command()
@click.argument("scenario")
@click.option("-o", "--output", metavar="F.mcap", help="The log to write.")
@click.option("--seed", type=int, help="Of the flight (default: the scenario's).")
@click.option(
    "--serve", is_flag=True, help="Fly a mission in real time, with MAVLink and a camera on the loopback."
)
@click.option("--mavlink-port", default=14550, show_default=True, metavar="N", help="Where onboard listens.")
@click.option(
    "--camera-port", default=8090, show_default=True, metavar="N", help="Where the camera is served."
)
@click.option(
    "--flight-files", metavar="DIR", help="Write flight.toml, camera.toml and target.toml for onboard."
)
@_FORCE
def simulate(
    scenario: str,
    output: str | None,
    seed: int | None,
    serve: bool,
    mavlink_port: int,
    camera_port: int,
    flight_files: str | None,
    force: bool,
) -> None:
    """Write the log of a simulated flight: a scenario's name or TOML file, and a seed.

    With --serve the vehicle of a mission waits for deckfix onboard, in another terminal, to land it.
    """
    if serve:
        from deckfix.serving import Ports, serve_command

        ports = Ports(mavlink_port, camera_port)
        _say(
            serve_command(scenario, output, seed=seed, ports=ports, files=flight_files, force=force, say=_say)
        )
        return
    from deckfix.demo import simulate_flight

    if output is None:
        raise click.UsageError("Missing option '-o' / '--output'.")
    _say(simulate_flight(scenario, output, seed=seed, force=force))


@deckfix.command()
@click.argument("folder", metavar="DIR")
@click.option(
    "-o", "--output", default="fleet", show_default=True, metavar="OUT", help="The folder of the results."
)
@click.option(
    "--config",
    "config_path",
    metavar="C.toml",
    help="Configuration (default: each log's own, else built in).",
)
@click.option("--reports/--no-reports", default=True, help="Write each flight's report (about 5 MB each).")
@_ENGINE
@_JOBS
@_SCHEDULER
@_FORCE
def fleet(
    folder: str, output: str, config_path: str | None, reports: bool, engine: str, jobs: int | None,
    scheduler: str | None, force: bool,
) -> None:  # fmt: skip
    """Replay every flight below a folder: one row each, and a page that links the reports.

    What was done before is not done again; --force replays all.
    """
    from deckfix.fleet import FleetOptions, run_fleet

    chosen: Any = engine
    _say(run_fleet(folder, output, FleetOptions(config_path, chosen, reports, jobs, scheduler, force)))


@deckfix.command()
def doctor() -> None:
    """Check the installation and say what is wrong with it."""
    from deckfix.doctor import examine

    text, healthy = examine()
    _say(text)
    if not healthy:
        raise SystemExit(1)


@deckfix.command()
@click.option(
    "-o", "--output", default="demo", show_default=True, metavar="DIR", help="The folder to write to."
)
@click.option("--seed", default=1, show_default=True, help="Of the simulated flight.")
@_FORCE
def demo(output: str, seed: int, force: bool) -> None:
    """Fly a landing on rendered pictures, replay its log, write the report.

    The whole loop, search to touchdown on a raft in Beaufort 2, in a minute or so; needs no data.
    """
    from deckfix.demo import run_demo

    _say(run_demo(output, seed=seed, force=force))


deckfix.add_command(detect)
deckfix.add_command(onboard)
deckfix.add_command(target)
deckfix.add_command(calibrate)
deckfix.add_command(heave)
deckfix.add_command(sync)
deckfix.add_command(tune)


def _say(text: str) -> None:
    click.echo(text)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line (``sys.argv`` without arguments) and return its exit code."""
    _stop_on_termination()
    try:
        return int(deckfix.main(args=arguments, prog_name="deckfix", standalone_mode=False) or 0)
    except click.UsageError as error:
        command = error.ctx.command_path if error.ctx else "deckfix"
        return _fail(f"{_one_line(error.format_message()).rstrip('.')}; see {command} --help", 2)
    except click.ClickException as error:
        return _fail(error.format_message(), error.exit_code)
    except (click.Abort, KeyboardInterrupt):
        return _fail("interrupted; files that were not finished are not written", 130)
    except BrokenPipeError:
        # The reader of the output went away; nothing is left to be said to it.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else 1
    except Exception as error:
        return _fail(*_explained(error))


def _explained(error: Exception) -> tuple[str, int]:
    """Return the one line and the exit code for an error."""
    if os.environ.get("DECKFIX_TRACEBACK"):
        import traceback

        traceback.print_exception(error)
    if isinstance(error, OSError):
        name = error.filename if error.filename is not None else "input or output"
        reason = error.strerror or type(error).__name__
        return f"{name}: {reason.lower()}; check the path, the permissions and the space left", 1
    if isinstance(error, MemoryError):
        return "out of memory; use a shorter log, or a machine with more", 1
    if isinstance(error, _known_errors()):
        return str(error), 1
    return (
        f"internal error ({type(error).__name__}: {error}); please report it with the output of "
        "deckfix doctor (DECKFIX_TRACEBACK=1 shows where it happened)"
    ), 1


def _known_errors() -> tuple[type[Exception], ...]:
    """Return the errors whose message is meant for the user."""
    from deckfix.files import InputError, OutputError
    from estimation.config import ConfigError
    from logs.errors import LogError

    return LogError, ConfigError, InputError, OutputError, ImportError


def _fail(message: str, code: int) -> int:
    try:
        click.echo(f"deckfix: {_one_line(message)}", err=True)
    except BrokenPipeError:
        return code
    return code


def _one_line(message: str) -> str:
    from deckfix.terminal import printable

    return printable(" ".join(message.split()))


def _stop_on_termination() -> None:
    """Let SIGTERM unwind as Ctrl-C does, so that half-written files are removed."""

    def stop(number: int, frame: FrameType | None) -> None:
        raise SystemExit(128 + number)

    handler: Any = stop
    try:
        signal.signal(signal.SIGTERM, handler)
    except ValueError:
        # Not the main thread: the caller's own handling stays.
        return


if __name__ == "__main__":
    sys.exit(main())
