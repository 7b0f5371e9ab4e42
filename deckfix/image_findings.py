"""What went wrong with the images of a log: not looked at, damaged, or without a fix."""

from __future__ import annotations

from collections.abc import Iterator

from deckfix.finding import Finding, Severity
from deckfix.result import Result

MANY_DAMAGED = 0.01
"""Share of the frames that cannot be decoded above which that is a warning."""


def image_findings(result: Result) -> Iterator[Finding]:
    """Yield what is worth telling of the log's images; nothing where it holds none."""
    told = result.images
    if told is None:
        return
    if told.source == "none":
        lacking = told.lacking
        yield Finding(
            Severity.WARNING if lacking else Severity.NOTE,
            told.sentence(),
            "what a frame shows needs the camera and the target's size" if lacking else "they were left out",
            "add them: deckfix import F.mcap --camera C.toml --target T.toml -o G.mcap"
            if lacking
            else "nothing; --images looks at them",
        )
        return
    if told.source == "recorded":
        return
    if told.undecodable:
        many = told.undecodable > MANY_DAMAGED * told.frames
        yield Finding(
            Severity.WARNING if many else Severity.NOTE,
            f"{told.undecodable} of {told.frames} images cannot be decoded",
            "they were damaged when they were recorded or copied, or are of a format other than JPEG and PNG",
            "nothing, if they are few: they are left out; else look at the recorder and its disk",
        )
    if told.no_fix:
        n = sum(told.no_fix.values())
        reasons = ", ".join(f"{reason} ({count})" for reason, count in list(told.no_fix.items())[:5])
        none = n + told.undecodable == told.frames
        yield Finding(
            Severity.WARNING if none else Severity.NOTE,
            f"{n} of {told.frames} images showed no target",
            f"the target was out of sight, or could not be told for sure: {reasons}",
            "nothing, where it was out of sight; else check camera.toml and target.toml against the recording",
        )
