"""The command ``tune``: the noises under which the measurements of some flights are likeliest, as a configuration.

The likelihood is ``deckfix.tune_objective``, the search ``deckfix.tune_search``. Every replay's result is kept in a
file beside the output as soon as it is there; since the search is the same each time, an interrupted tuning that is run
again comes to where it was without a replay. Flights that are held out decide: what is no better there is not written.
"""

from __future__ import annotations

import hashlib
import json
import shlex
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from deckfix._version import __version__
from deckfix.commands import write_text
from deckfix.files import InputError, OutputError, check_output, existing
from deckfix.parallel import WorkerLost, Workers
from deckfix.replaying import configuration
from deckfix.terminal import printable, working
from deckfix.tune_objective import PARTS, Refused, Score, Trial, score
from deckfix.tune_parameters import Parameter, choose, with_values
from deckfix.tune_report import Tuned, TunedFlight, provenance, report
from deckfix.tune_search import EDGE, Certainty, Found, Search
from estimation.config import Config, dump_config, load_config, parse_config
from estimation.frames import Array

if TYPE_CHECKING:
    from estimation.estimator import EngineName

DRAWN = np.log(10.0)
"""Further starts are drawn within a factor of ten about the first."""
DIGITS = 4
"""Significant digits of what is written: no flight tells more."""
STATE = ".tuning.jsonl"
"""Ending of the file beside the output in which replays are kept until the tuning is done."""


@dataclass(frozen=True, slots=True)
class TuneOptions:
    """How to tune. ``config`` is a path (None: the logs' own configuration where they agree, else the default);
    ``parameters`` and ``bounds`` as in ``deckfix.tune_parameters.choose``."""

    config: str | None = None
    parameters: tuple[str, ...] = ()
    bounds: tuple[str, ...] = ()
    truth_weight: float = 0.0
    starts: int = 2
    seed: int = 1
    engine: EngineName = "auto"
    jobs: int | None = None
    scheduler: str | None = None
    force: bool = False


@dataclass(slots=True)
class _Replays:
    """Replays of the flights that are tuned on, each kept in ``state`` with what it gave."""

    workers: Workers
    paths: list[str]
    base: str
    parameters: list[Parameter]
    options: TuneOptions
    state: Path
    known: dict[str, list[float]] = field(default_factory=dict)

    def trial(self, path: str, values: tuple[tuple[str, float], ...]) -> Trial:
        return Trial(path, self.base, values, self.options.engine, self.options.truth_weight)

    def scores(self, trials: list[Trial]) -> list[Score | Refused]:
        out: list[Score | Refused] = [Refused("")] * len(trials)
        for index, answer in self.workers.each(score, trials):
            if isinstance(answer, WorkerLost):
                raise InputError(f"{trials[index].path}: {answer}")
            out[index] = answer
        return out

    def objective(
        self, fixed: tuple[tuple[str, float], ...], free: list[str], points: Sequence[Array]
    ) -> list[Array]:
        """Return the log-likelihoods of the parts of all flights at points of the free parameters' logarithms."""
        trials, names = list[Trial](), list[list[str]]()
        for point in points:
            values = (*fixed, *zip(free, np.exp(point).tolist(), strict=True))
            names.append([f"{n} {json.dumps(sorted(values))}" for n in range(len(self.paths))])
            trials += [
                self.trial(path, values)
                for name, path in zip(names[-1], self.paths, strict=True)
                if name not in self.known
            ]
        missing = list(dict.fromkeys(n for each in names for n in each if n not in self.known))
        unique = dict(zip((n for each in names for n in each if n not in self.known), trials, strict=True))
        with self.state.open("a", encoding="utf-8") as file:
            for index, answer in self.workers.each(score, [unique[n] for n in missing]):
                if not isinstance(answer, Score):
                    raise InputError(answer.reason if isinstance(answer, Refused) else str(answer))
                self.known[missing[index]] = list(answer.parts)
                file.write(json.dumps([missing[index], answer.parts]) + "\n")
                file.flush()
        return [np.concatenate([self.known[n] for n in each]) for each in names]


def run_tune(
    files: Sequence[str], holdouts: Sequence[str], output: str | Path, options: TuneOptions
) -> tuple[str, bool]:
    """Tune on flights and return what to show, and whether the configuration was written.

    Raises ``InputError`` where there is nothing to tune or no flight to tune on, ``OutputError`` where the output may
    not be written, ``logs.errors.LogError`` and ``estimation.config.ConfigError`` for what cannot be read.
    """
    _distinct([*files, *holdouts])
    target = check_output(
        output, force=options.force, inputs=[*files, *holdouts, *([options.config] if options.config else [])]
    )
    base, source, remarks = _base([*files], options.config)
    text = dump_config(base)
    with Workers(options.jobs, options.scheduler) as workers, working("tuning"):
        replays = _Replays(workers, [], text, [], options, target.with_name(target.name + STATE))
        before = dict(zip([*files, *holdouts], _first(replays, [*files, *holdouts], remarks), strict=True))
        tuned_on = [f for f in files if isinstance(before[f], Score)]
        held_out = [f for f in holdouts if isinstance(before[f], Score)]
        _enough(files, tuned_on, holdouts, held_out, remarks)
        kinds = {
            s.kind for f in tuned_on if isinstance(one := before[f], Score) for s in one.sensors.values()
        }
        parameters, left_out = choose(base, kinds, options.parameters, options.bounds)
        remarks += left_out
        if not parameters:
            raise InputError("; ".join(["there is no parameter to tune", *left_out]))
        replays.paths = [str(Path(f).resolve()) for f in tuned_on]
        replays.parameters = parameters
        hashes = {f: _sha256(f) for f in (*tuned_on, *held_out)}
        _resume(replays, [hashes[f] for f in tuned_on], remarks)
        values, certainty, replays_done = _searched(replays)
        chosen = tuple((p.name, v) for p, v in zip(parameters, values, strict=True))
        trials = [replays.trial(str(Path(f).resolve()), chosen) for f in (*tuned_on, *held_out)]
        after = dict(zip((*tuned_on, *held_out), replays.scores(trials), strict=True))
    flights, names = [], [Path(f).name for f in (*tuned_on, *held_out)]
    for f in (*tuned_on, *held_out):
        start, end = before[f], after[f]
        if isinstance(start, Refused) or isinstance(end, Refused):
            raise InputError(f"{f}: could be replayed at first, and then no more; was it changed meanwhile?")
        name = Path(f).name if names.count(Path(f).name) == 1 else f
        flights.append(TunedFlight(name, hashes[f], f in held_out, start, end))
    command = _command(files, holdouts, output, options)
    tuned = Tuned(parameters, values, certainty, flights, command, source, replays_done, options.truth_weight)
    written = tuned.better
    if written:
        config = parse_config(dump_config(with_values(base, chosen)), "the tuned configuration")
        write_text(target, provenance(tuned) + dump_config(config), force=options.force)
    replays.state.unlink(missing_ok=True)
    lines = [*remarks, report(tuned)]
    lines.append(f"wrote {target}" if written else f"{target}: not written: {tuned.verdict}")
    return "\n".join(printable(line) for text in lines for line in text.split("\n")), written


def _searched(replays: _Replays) -> tuple[list[float], Certainty, int]:
    """Return the values of all parameters, those of which the flights tell nothing as they were, and the certainty."""
    parameters = replays.parameters
    centre = np.log([p.start for p in parameters])
    lower, upper = np.log([p.lower for p in parameters]), np.log([p.upper for p in parameters])
    free = np.arange(len(parameters))
    point, sigma = centre.copy(), np.full(len(centre), np.inf)
    at_bound = np.zeros(len(centre), dtype=bool)
    found: Found | None = None
    certainty: Certainty | None = None
    keep, answer = np.ones(len(centre), dtype=bool), np.zeros(0)
    evaluations = 0
    while True:
        fixed = tuple((p.name, p.start) for k, p in enumerate(parameters) if k not in free)
        names = [parameters[k].name for k in free]

        def objective(points: Sequence[Array], fixed: Any = fixed, names: list[str] = names) -> list[Array]:
            return replays.objective(fixed, names, points)

        search = Search(objective, lower[free], upper[free], centre[free])
        if found is None:
            rng = np.random.default_rng(replays.options.seed)
            draws = [rng.uniform(-DRAWN, DRAWN, len(free)) for _ in range(replays.options.starts - 1)]
            ends = [search.run(centre[free] + d) for d in (np.zeros(len(free)), *draws)]
            found, certainty = search.certainty(min(ends, key=lambda e: e.value))
        else:
            assert certainty is not None
            # What is put back was not identified: the others answer to it as the curvature says.
            places = [point[free], np.clip(point[free] + answer, lower[free], upper[free])]
            values = search.values(places)
            best = int(np.argmin(values))
            if values[best] < found.value + EDGE * np.count_nonzero(~keep):
                found, certainty = Found(places[best], float(values[best])), certainty.kept(keep)
            else:
                found, certainty = search.certainty(search.run(places[best], sweep=False))
        point[free] = found.point
        sigma[:], at_bound[:] = np.inf, False
        sigma[free], at_bound[free] = certainty.sigma, certainty.at_bound
        keep = certainty.identified | certainty.at_bound
        keep |= _limited(search, found, certainty, keep)
        evaluations += search.evaluations
        if keep.all():
            break
        answer = certainty.answer(keep, centre[free] - point[free])
        free = free[keep]
        if not len(free):
            raise InputError(
                "no parameter can be identified from these flights; tune fewer (--parameters), or give more flights, "
                "with more motion"
            )
    values = np.log([p.start for p in parameters])
    values[free] = point[free]
    rounded = [float(f"{v:.{DIGITS}g}") for v in np.exp(values)]
    whole = [p.start if k not in free else rounded[k] for k, p in enumerate(parameters)]
    return whole, Certainty(sigma, at_bound, certainty.information), evaluations * len(replays.paths)


def _limited(
    search: Search, found: Found, certainty: Certainty, keep: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Return which parameters besides those to ``keep`` are known by a limit: flat where the search ended, and yet
    putting one of them back to where it was costs more than ``EDGE``, also where the others answer to it.
    """
    places, which = list[Array](), np.flatnonzero(~keep)
    for k in which:
        others = np.arange(len(keep)) != k
        back = found.point.copy()
        back[k] = search.centre[k]
        answered = back.copy()
        answered[others] += certainty.answer(others, back - found.point)
        places += [back, np.clip(answered, search.lower, search.upper)]
    out = np.zeros(len(keep), dtype=bool)
    if places:
        out[which] = search.values(places).reshape(-1, 2).min(axis=1) > found.value + EDGE
    return out


def _first(replays: _Replays, files: Sequence[str], remarks: list[str]) -> list[Score | Refused]:
    """Return what each flight gives at the start; a flight that cannot be used is told of and left out."""
    answers = replays.scores([replays.trial(str(Path(f).resolve()), ()) for f in files])
    remarks += [f"left out: {a.reason}" for a in answers if isinstance(a, Refused)]
    return answers


def _enough(
    files: Sequence[str],
    tuned_on: list[str],
    holdouts: Sequence[str],
    held_out: list[str],
    remarks: list[str],
) -> None:
    why = "; ".join(r.removeprefix("left out: ") for r in remarks if r.startswith("left out: "))
    if not tuned_on:
        raise InputError(f"none of the {len(files)} flights can be tuned on: {why}")
    if holdouts and not held_out:
        raise InputError(f"none of the flights that were to decide can be used: {why}")


def _base(files: list[str], path: str | None) -> tuple[Config, str, list[str]]:
    """Return the configuration to start from, where it comes from, and what is odd about that."""
    from deckfix.replaying import open
    from logs.errors import LogError

    if path is not None:
        return load_config(existing(path)), f"the configuration in {path}", []
    own = []
    for file in files:
        try:
            own.append(configuration(open(existing(file)), None))
        except LogError:
            continue  # told of when it is replayed
    if own and all(dump_config(c) == dump_config(own[0][0]) for c, _ in own):
        return *own[0], []
    if not own:
        return Config(), "the default configuration", []
    remark = (
        "the logs carry different configurations: starting from the default one; name yours with --config"
    )
    return Config(), "the default configuration", [remark]


def _distinct(files: list[str]) -> None:
    seen: dict[Path, str] = {}
    for file in files:
        place = existing(file).resolve()
        if place in seen:
            raise InputError(f"{file}: is named twice; a flight is tuned on or held out, once")
        seen[place] = file


def _sha256(file: str) -> str:
    with Path(file).open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _resume(replays: _Replays, hashes: list[str], remarks: list[str]) -> None:
    """Take up the replays of an interrupted tuning of the same flights from the same configuration.

    Raises ``OutputError`` where the file is of another tuning and may not be overwritten.
    """
    o = replays.options
    told = json.dumps([__version__, PARTS, replays.base, hashes, o.truth_weight, o.engine])
    heading = json.dumps({"deckfix tune": hashlib.sha256(told.encode()).hexdigest()})
    try:
        lines = replays.state.read_text(encoding="utf-8").splitlines()
    except FileNotFoundError:
        lines = []
    if lines and lines[0] == heading:
        for line in lines[1:]:
            try:
                name, value = json.loads(line)
            except ValueError:
                continue  # the line that was being written
            replays.known[str(name)] = [float(v) for v in value]
        remarks.append(f"taking up an interrupted tuning: {len(replays.known)} replays are known")
    elif lines and not o.force:
        raise OutputError(
            f"{replays.state}: is left from another tuning; delete it, or use --force to overwrite it"
        )
    entries = [json.dumps([n, v]) for n, v in replays.known.items()]
    write_text(replays.state, "\n".join([heading, *entries]) + "\n", force=True)


def _command(files: Sequence[str], holdouts: Sequence[str], output: str | Path, o: TuneOptions) -> str:
    """Return the command that says all that the result depends on."""
    words = ["deckfix", "tune", *files]
    for name, values in (("--holdout", holdouts), ("--parameters", o.parameters), ("--bounds", o.bounds)):
        for value in values:
            words += [name, value]
    if o.config is not None:
        words += ["--config", o.config]
    if o.truth_weight > 0.0:
        words += ["--truth", f"{o.truth_weight:g}"]
    return shlex.join([*words, "--starts", str(o.starts), "--seed", str(o.seed), "-o", str(output)])
