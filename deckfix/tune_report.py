"""What a tuning came to: in words for the terminal, and as comments at the head of the configuration."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from deckfix._version import __version__
from deckfix.tune_objective import Score
from deckfix.tune_parameters import Parameter, factor_in_words
from deckfix.tune_search import Certainty


@dataclass(frozen=True, slots=True)
class TunedFlight:
    """A flight, whether it was held out, and its likelihood at the start and tuned."""

    name: str
    sha256: str
    held_out: bool
    start: Score
    tuned: Score

    @property
    def gain(self) -> float:
        """How much likelier the flight has become (a difference of logarithms)."""
        return self.tuned.log_likelihood - self.start.log_likelihood


@dataclass(frozen=True, slots=True)
class Tuned:
    """The result: ``values`` of all parameters, how certain they are, and what the flights say."""

    parameters: list[Parameter]
    values: list[float]
    certainty: Certainty
    flights: list[TunedFlight]
    command: str
    source: str
    replays: int
    truth_weight: float

    def gain(self, held_out: bool) -> float:
        """Return the gain over the flights that were, or were not, held out."""
        return sum(f.gain for f in self.flights if f.held_out is held_out)

    @property
    def better(self) -> bool:
        """Whether it is to be written: better on what it was tuned on, and on what was held out."""
        return self.verdict == ""

    @property
    def verdict(self) -> str:
        """Why it is not to be written; empty where it is."""
        if not self.gain(False) > 0.0:
            return "nothing likelier was found; the configuration stays as it is"
        if any(f.held_out for f in self.flights) and not self.gain(True) > 0.0:
            return (
                f"the flights that were held out are less likely with it ({self.gain(True):+.1f}); tune on more "
                "flights, or fewer parameters"
            )
        return ""


def report(tuned: Tuned) -> str:
    """Return what to show."""
    return "\n".join(_lines(tuned))


def provenance(tuned: Tuned) -> str:
    """Return the comments with which the configuration begins: what it was made of, and by what."""
    lines = [f"Tuned by deckfix {__version__}: {tuned.command}", f"from {tuned.source}"]
    for f in tuned.flights:
        role = "held out" if f.held_out else "tuned on"
        lines.append(
            f"{role} {f.name} (sha256 {f.sha256}): log-likelihood {f.start.log_likelihood:.2f} at the start, "
            f"{f.tuned.log_likelihood:.2f} tuned"
        )
    lines += list(_lines(tuned))
    return (
        "".join(f"# {''.join(c if c.isprintable() else '?' for c in line)}".rstrip() + "\n" for line in lines)
        + "\n"
    )


def _lines(tuned: Tuned) -> Iterator[str]:
    known = tuned.certainty.identified
    here = [f for f in tuned.flights if not f.held_out]
    held = [f for f in tuned.flights if f.held_out]
    yield (
        f"tuned on {_count(len(here), 'flight')}, {len(held)} held out; {int(known.sum())} of "
        f"{_count(len(known), 'parameter')} identified, from {tuned.replays} replays"
    )
    if tuned.truth_weight > 0.0:
        yield f"  the truth in the logs counts too, with weight {tuned.truth_weight:g}"
    width = max(len(p.name) for p in tuned.parameters)
    for p, value, sigma, bound, sure in zip(
        tuned.parameters, tuned.values, tuned.certainty.sigma, tuned.certainty.at_bound, known, strict=True
    ):
        if sure:
            low, high = (value * math.exp(s * 1.96 * sigma) for s in (-1.0, 1.0))
            change = factor_in_words(value / p.start)
            yield (
                f"  {p.name:{width}s} {p.start:.4g} -> {value:.4g} {p.unit}: {change} (95 %: {low:.3g} to "
                f"{high:.3g}); {p.meaning}"
            )
        elif bound:
            yield (
                f"  {p.name:{width}s} {p.start:.4g} -> {value:.4g} {p.unit}: at its bound, so the flights want it "
                "beyond; what it stands for may be missing in the model"
            )
        elif value != p.start:
            side = "larger" if value < p.start else "smaller"
            yield (
                f"  {p.name:{width}s} {p.start:.4g} -> {value:.4g} {p.unit}: only a limit is known, it may not be much "
                f"{side}; {p.meaning}"
            )
    unknown = [
        p.name
        for p, value, k, b in zip(
            tuned.parameters, tuned.values, known, tuned.certainty.at_bound, strict=True
        )
        if not (k or b) and value == p.start
    ]
    if unknown:
        yield f"  not identified, left as they were: {', '.join(unknown)}"
    yield "log-likelihood of the measurements:"
    for f in tuned.flights:
        yield (
            f"  {'held out: ' if f.held_out else ''}{f.name}: {f.start.log_likelihood:.1f} -> "
            f"{f.tuned.log_likelihood:.1f} ({f.gain:+.1f})"
        )
    yield "NIS over degrees of freedom (1 is honest) and share rejected, at the start -> tuned:"
    for title, flights in (("", here), ("held out: ", held)):
        for name in dict.fromkeys(n for f in flights for n in f.start.sensors):
            start, end = (_pooled(flights, name, which) for which in ("start", "tuned"))
            yield f"  {title}{name}: {start[0]:.2f} -> {end[0]:.2f}, {start[1]:.1%} -> {end[1]:.1%}"
    if not held:
        yield "no flight was held out: this fits these flights, and may not fit others (--holdout)"


def _pooled(flights: list[TunedFlight], sensor: str, which: str) -> tuple[float, float]:
    """Return a sensor's mean NIS over degrees of freedom and its share rejected, over all flights."""
    scores: list[Score] = [getattr(f, which) for f in flights]
    found = [s.sensors[sensor] for s in scores if sensor in s.sensors]
    counts = np.array([s.count for s in found], dtype=np.float64)
    nis = np.array([s.nis_over_dof for s in found])
    compared = np.isfinite(nis)
    mean = float(np.average(nis[compared], weights=counts[compared])) if compared.any() else math.nan
    return mean, float(np.average([s.rejected for s in found], weights=counts))


def _count(n: int, noun: str) -> str:
    return f"{n} {noun}" + ("" if n == 1 else "s")
