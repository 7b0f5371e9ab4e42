"""Write docs/reference/*.md from the code: configuration, topics, commands.

    python docs/reference.py

The pages are committed, and a test demands that they are what this writes: what they say cannot drift from the code.
"""

from __future__ import annotations

import inspect
import json
import re
from collections.abc import Callable, Iterator
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

import click
import msgspec

import logs.topics
from deckfix.cli import deckfix
from deckfix.flight_file import OnboardTable
from deckfix.pipeline import DetectorSettings
from estimation.config import Config
from estimation.outcome import EXPLANATIONS, Outcome
from estimation.state import BLOCKS
from logs.topics import TOPICS, definition_text
from simulation.fixes import View
from simulation.flight import Scenario, SiteTable, WavesTable, WindTable
from simulation.platform import Raft
from simulation.sea import Wave
from simulation.sensors import Clock, Stream, Streams, VisionStream
from simulation.trajectory import Plan, Rock

FOLDER = Path(__file__).with_name("reference")
WRITTEN = "<!-- Written by docs/reference.py from the code. Change the code, then run it again. -->\n"


def configuration() -> str:
    """Return the page of the configuration: every table of ``estimation.config.Config``, and ``[onboard]``."""
    parts = [
        WRITTEN,
        "# Configuration\n",
        "A TOML file with any of these tables. What a file leaves out has its default; an unknown key is refused with",
        "the nearest valid name, and a value outside its bounds with the bound. Every log that deckfix writes carries",
        "its whole configuration as the attachment `config.toml`. How to use one: [quick start]"
        "(../quick-start.md#configure).\n",
        "Process noise is a rate (per root second, `rts`, or per root hertz, `rtHz`), so that it does not depend on",
        "a sensor's rate.\n",
    ]
    for name, kind in get_type_hints(Config).items():
        parts += [f"## `[{name}]`\n", sentence(kind), "", *table_of(kind), ""]
    parts += [
        "## `[onboard]`\n",
        "Only in the file that `deckfix onboard` reads ([on board](../onboard.md)).\n",
        sentence(OnboardTable),
        "",
        *table_of(OnboardTable),
        "",
        "## `[onboard.detector]`\n",
        sentence(DetectorSettings),
        "",
        *table_of(DetectorSettings),
        "",
    ]
    return "\n".join(parts)


def table_of(kind: type[msgspec.Struct]) -> Iterator[str]:
    """Yield the lines of the table of a configuration's table."""
    hints = get_type_hints(kind, include_extras=True)
    described = any(meta_of(hint).description for hint in hints.values())
    titles = ["key", "default", "unit", "allowed", "meaning"] if described else ["key", "default", "allowed"]
    rows = []
    for field in msgspec.structs.fields(kind):
        hint, meta = hints[field.name], meta_of(hints[field.name])
        factory = field.default_factory
        value = field.default if factory is msgspec.NODEFAULT else factory()
        if isinstance(value, msgspec.Struct | dict):
            continue
        cells = [f"`{field.name}`", shown(value)]
        cells += [(meta.extra or {}).get("unit", "-")] if described else []
        cells += [allowed(hint, meta)] + ([meta.description or ""] if described else [])
        rows.append(cells)
    if rows:
        yield "| " + " | ".join(titles) + " |"
        yield "|---" * len(titles) + "|"
    for cells in rows:
        yield "| " + " | ".join(cell(c) for c in cells) + " |"


def meta_of(hint: Any) -> msgspec.Meta:
    """Return what an annotation says beside its type."""
    found = (m for m in get_args(hint) if isinstance(m, msgspec.Meta))
    return next(found, msgspec.Meta())


def shown(value: object) -> str:
    """Return a default as it would stand in the file."""
    if value is msgspec.NODEFAULT:
        return "required"
    if value is None:
        return "none"
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    if isinstance(value, str):
        return f'`"{value}"`'
    if isinstance(value, datetime):
        return f"`{value.isoformat()}`"
    if isinstance(value, tuple):
        return f"`{json.dumps(value)}`"
    return f"`{value!r}`"


def allowed(hint: Any, meta: msgspec.Meta) -> str:
    """Return the values that are allowed: a type, a choice, or a type with its bounds."""
    kind = get_args(hint)[0] if get_origin(hint) is Annotated else hint
    if get_origin(kind) is Literal:
        return ", ".join(f'`"{choice}"`' for choice in get_args(kind))
    if get_origin(kind) is tuple:
        inner = [k for k in get_args(kind) if k is not Ellipsis]
        if any(get_origin(k) is tuple for k in inner):
            return f"a list of lists of {len(get_args(inner[0]))} numbers"
        if any(isinstance(k, type) and issubclass(k, msgspec.Struct) for k in inner):
            return "tables, below"
        return "a list of numbers" if len(inner) < len(get_args(kind)) else f"{len(inner)} numbers"
    kinds = [k for k in get_args(kind) if k is not type(None)]
    if kinds:
        return ", ".join(allowed(k, meta_of(k) if get_origin(k) is Annotated else meta) for k in kinds)
    if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
        return "a table, below"
    words = {
        float: "number",
        int: "whole number",
        bool: "true, false",
        str: "text",
        datetime: "date and time",
    }
    word = words[kind]
    bounds = [
        f"{sign} {bound:g}"
        for sign, bound in ((">", meta.gt), ("≥", meta.ge), ("<", meta.lt), ("≤", meta.le))
        if bound is not None
    ]
    return word + (f" {' and '.join(bounds)}" if bounds else "")


def scenario() -> str:
    """Return the page of the files that ``deckfix simulate`` takes: the tables of a scenario."""
    parts = [
        WRITTEN,
        "# Scenarios\n",
        "What a TOML file for `deckfix simulate` may say ([how](../simulate.md)). `[filter]` is a",
        "[configuration](configuration.md): the estimator is told it, and the sensors are drawn from it; `[mismatch]`,",
        "of the same tables, replaces it for the drawing alone, so that the estimator is told something else than is",
        "true. Names carry their units.\n",
        "## Top of the file\n",
        *table_of(Scenario),
        "",
    ]
    tables: list[tuple[str, type[msgspec.Struct]]] = [
        ("site", SiteTable), ("plan", Plan), ("sea", WavesTable), ("sea.waves", Wave), ("raft", Raft),
        ("wind", WindTable), ("rock", Rock), ("streams", Streams), ("streams.SENSOR", Stream),
        ("streams.vision", VisionStream), ("streams.vision.view", View), ("clocks.NAME", Clock),
    ]  # fmt: skip
    for name, kind in tables:
        title = f"`[[{name}]]`" if kind is Wave else f"`[{name}]`"
        parts += [f"## {title}\n", sentence(kind), "", *table_of(kind), ""]
    return "\n".join(parts)


def topics() -> str:
    """Return the page of the topics: what is in a log, in which message, and deckfix's own messages."""
    columns = described_columns()
    parts = [
        WRITTEN,
        "# Topics of a log\n",
        "Logs are MCAP files of profile `ros2`: CDR messages whose definitions are in the file, so that any ROS 2 tool",
        "shows them. `log_time` is a message's arrival (UTC). `header.stamp` is the source's own stamp plus one",
        "constant per clock, which the file's metadata `deckfix.clocks` holds; a channel's metadata names its clock.",
        "Unknown topics pass through a replay unchanged.\n",
        "| topic | message | frame_id | child_frame_id |",
        "|---|---|---|---|",
    ]
    for topic in TOPICS.values():
        child = topic.strings.get("child_frame_id", "")
        parts.append(f"| `{topic.name}` | `{topic.message_type}` | {code(topic.frame_id)} | {code(child)} |")
    parts += [
        "",
        "## Columns\n",
        "`deckfix.open(path).series(topic)[0].data` holds a topic's messages as columns: the message's numbers, named",
        "by their path with underscores, without header and strings. In brackets: entries of a column that has",
        "several.\n",
        "| topic | columns |",
        "|---|---|",
        *(f"| {cell(name)} | {cell(text)} |" for name, text in columns),
        "",
        "## Outcomes\n",
        "`/fusion` has one message for each measurement, with what became of it:\n",
        "| `outcome` | name | meaning |",
        "|---|---|---|",
        *(f"| {o.value} | {o.name} | {EXPLANATIONS[o]} |" for o in Outcome),
        "",
        "## States\n",
        "`/estimate/state` names each state `block.component`; blocks that the configuration switches off are absent.",
        "Attitude is the rotation vector from NED to the body; its sigma is of the error about the body's axes.\n",
        "| block | components | unit |",
        "|---|---|---|",
        *(
            f"| `{name}` | {', '.join(f'`{c}`' for c in components)} | {unit} |"
            for name, components, unit in BLOCKS
        ),
        "",
        "## Messages of deckfix\n",
    ]
    own = sorted({t.message_type for t in TOPICS.values() if t.message_type.startswith("deckfix_msgs/")})
    for message in own:
        used = [f"`{t.name}`" for t in TOPICS.values() if t.message_type == message]
        body = definition_text(message).split("=" * 80)[0]
        parts += [
            f"### {message.rsplit('/', 1)[1]}\n",
            f"On {', '.join(used)}.\n",
            f"```\n{body.strip()}\n```\n",
        ]
    return "\n".join(parts)


def described_columns() -> list[tuple[str, str]]:
    """Return topic and columns from the table at the top of ``logs.topics``."""
    text = inspect.getdoc(logs.topics) or ""
    rows: list[tuple[str, str]] = []
    for line in text.split("\n"):
        name, words = line[:28].strip(), line[28:].strip()
        if line.startswith("="):
            continue
        if rows and not name and words:
            rows[-1] = (rows[-1][0], f"{rows[-1][1]} {words}")
        elif words and (name.startswith("/") or name == "odometry topics"):
            rows.append((re.sub(r"/\S+?(?=,|$)", lambda m: f"`{m[0]}`", name), words))
    return rows


def commands() -> str:
    """Return the page of the commands with their arguments and options."""
    parts = [
        WRITTEN,
        "# Commands\n",
        "Errors are one line on standard error, `deckfix: FILE: what is wrong; what to do`. The exit code is 0, 1 for",
        "an error, 2 for a wrong command line, 130 after Ctrl-C. Nothing is overwritten without `--force`.\n",
    ]
    for name in deckfix.list_commands(click.Context(deckfix)):
        command = deckfix.commands[name]
        arguments = [p for p in command.params if isinstance(p, click.Argument)]
        options = [p for p in command.params if isinstance(p, click.Option)]
        usage = " ".join(
            ["deckfix", name, *(["[OPTIONS]"] if options else []), *(placeholder(a) for a in arguments)]
        )
        parts += [f"## deckfix {name}\n", f"```\n{usage}\n```\n", inspect.cleandoc(command.help or ""), ""]
        if options:
            parts += ["| option | meaning |", "|---|---|", *(row_of(option) for option in options), ""]
    return "\n".join(parts)


def row_of(option: click.Option) -> str:
    """Return an option's row of the table."""
    names = ", ".join([*option.opts, *option.secondary_opts])
    takes_nothing = option.is_flag or option.secondary_opts
    value = "" if takes_nothing else f" {placeholder(option)}"
    notes = ["required"] if option.required else []
    if option.show_default and isinstance(option.default, str | int | float):
        default = option.default
        notes += [f"default: {('on' if default else 'off') if isinstance(default, bool) else default}"]
    said = (option.help or "") + (f" [{'; '.join(notes)}]" if notes else "")
    return f"| `{(names + value).replace('|', chr(92) + '|')}` | {cell(said)} |"


def placeholder(parameter: click.Parameter) -> str:
    """Return what stands for a parameter's value in a command line."""
    if parameter.metavar:
        return parameter.metavar
    if isinstance(parameter.type, click.Choice):
        return "|".join(str(choice) for choice in parameter.type.choices)
    if isinstance(parameter, click.Argument):
        return (parameter.name or "").upper()
    return {"float": "NUMBER", "integer": "N", "integer range": "N", "float range": "NUMBER"}.get(
        parameter.type.name, "TEXT"
    )


def sentence(kind: type) -> str:
    """Return a docstring as one paragraph of Markdown."""
    return re.sub(r"``([^`]+)``", r"`\1`", " ".join((inspect.getdoc(kind) or "").split()))


def cell(text: str) -> str:
    """Return a text for a cell of a table."""
    return re.sub(r"``([^`]+)``", r"`\1`", " ".join(text.split())).replace("|", "\\|")


def code(text: str) -> str:
    """Return a text as code, or nothing for nothing."""
    return f"`{text}`" if text else ""


PAGES: dict[str, Callable[[], str]] = {
    "configuration.md": configuration,
    "topics.md": topics,
    "scenario.md": scenario,
    "commands.md": commands,
}


def main() -> None:
    """Write the pages."""
    FOLDER.mkdir(exist_ok=True)
    for name, page in PAGES.items():
        (FOLDER / name).write_text(page(), encoding="utf-8")
        print(f"wrote {FOLDER / name}")


if __name__ == "__main__":
    main()
