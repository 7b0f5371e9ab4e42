"""What went wrong: symptoms found in a result, with their likely cause and what to do about it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from deckfix.deck_findings import deck_findings
from deckfix.finding import Finding, Severity
from deckfix.image_findings import image_findings
from deckfix.result import Result
from estimation.events import Kind
from estimation.outcome import EXPLANATIONS, Outcome

_REMEDIES: dict[Outcome, tuple[str, str]] = {
    Outcome.REJECTED_GATE: (
        "an outlier of the sensor, a wrong latency or lever arm, or a noise configured too small",
        "look at its innovations: a constant offset is calibration or latency, single peaks are outliers",
    ),
    Outcome.REJECTED_NOT_FINITE: (
        "the source wrote NaN or infinity",
        "check the driver or the importer's source; the measurements were left out",
    ),
    Outcome.REJECTED_COVARIANCE: (
        "the source states an accuracy that is unusable or worse than the configured limit",
        "check the receiver's reported accuracy; raise the limit in the configuration if it is meant",
    ),
    Outcome.REJECTED_TOO_OLD: (
        "it arrived later than the rewind window",
        "raise filter.window_s, or find what delays the link",
    ),
    Outcome.REJECTED_FUTURE: (
        "its clock is ahead of the inertial clock, or inertial samples are missing",
        "check the time synchronisation of its clock, and the inertial gaps",
    ),
    Outcome.REJECTED_DUPLICATE: (
        "the source repeats its last measurement; a camera that does so for long has a picture that stands still",
        "nothing to do about single ones: repeats are not counted twice; look at a camera that repeats itself",
    ),
    Outcome.REJECTED_NOT_READY: (
        "the filter was not initialised, the sensor had no valid reading, or it is switched off",
        "if that was not intended, switch it on in the configuration",
    ),
}

_NEEDED = (
    (Kind.IMU, Severity.SERIOUS, "nothing can be estimated", "log the IMU (ArduPilot: LOG_BITMASK with IMU)"),
    (Kind.GPS_POSITION, Severity.SERIOUS, "position and velocity drift", "log the GPS"),
    (Kind.BAROMETER, Severity.WARNING, "height rests on GPS alone", "log the barometer"),
    (Kind.MAGNETOMETER, Severity.WARNING, "yaw is seen only through motion", "log the magnetometer"),
)


def findings(result: Result) -> list[Finding]:
    """Return what is worth telling, the worst first; an empty list means that nothing was found."""
    parts = (
        _readiness,
        _problems,
        _notes,
        _inputs,
        image_findings,
        _outcomes,
        _consistency,
        deck_findings,
        _biases,
        _uncertainty,
        _messages,
    )
    found = [f for part in parts for f in part(result)]
    return sorted(found, key=lambda f: -f.severity)


def verdict(result: Result, found: list[Finding]) -> str:
    """Return one sentence on whether the estimate can be used."""
    serious = sum(f.severity is Severity.SERIOUS for f in found)
    warnings = sum(f.severity is Severity.WARNING for f in found)
    if not len(result.run.t_ns):
        return "There is no estimate: the filter never became ready."
    if serious:
        return (
            f"Do not rely on this estimate before looking at the {_count(serious, 'serious finding')} below."
        )
    if warnings:
        deserve = "deserves" if warnings == 1 else "deserve"
        return f"The estimate is usable; {_count(warnings, 'thing')} {deserve} a look."
    if found:
        return f"Nothing went wrong that can be seen from the log; {_count(len(found), 'note')} below."
    return "Nothing went wrong that can be seen from the log."


def _count(n: int, noun: str) -> str:
    return f"{n} {noun}" + ("" if n == 1 else "s")


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %" if share >= 0.1 else f"{100 * share:.1f} %"


def _readiness(result: Result) -> Iterator[Finding]:
    if not len(result.run.t_ns):
        waited = f"it waited for {result.run.missing}" if result.run.missing else "it never became ready"
        yield Finding(
            Severity.SERIOUS,
            "no estimate came out",
            f"the filter needs inertial samples, a good GPS fix and a heading before it starts; {waited}",
            "see the sensors below: which of them is missing or rejected?",
        )
        return
    wait = result.seconds(int(result.run.t_ns[0]))
    if wait > 15.0:
        yield Finding(
            Severity.NOTE,
            f"the first estimate came {wait:.0f} s after the first inertial sample",
            "no good GPS fix, no heading, or no rest before that",
            "nothing, if the vehicle stood without GPS; else see the outcomes over time",
        )


_GRAVE = ("lost", "damaged", "backwards", "went back", "reset", "two vehicles", "fails", "cannot be decoded")
_HARMLESS = ("ends within a message",)


def _problems(result: Result) -> Iterator[Finding]:
    for problem in result.problems[:20]:
        low = problem.lower()
        grave = any(w in low for w in _GRAVE) and not any(w in low for w in _HARMLESS)
        yield Finding(
            Severity.WARNING if grave else Severity.NOTE,
            problem,
            "the file, or the recording, is incomplete or unusual",
            "what could be read was used; if the loss matters, copy the log again from its source",
        )
    if len(result.problems) > 20:
        yield Finding(
            Severity.WARNING,
            f"{len(result.problems) - 20} further problems in the log",
            "as above",
            "deckfix info lists all of them",
        )


_ALARMING = (
    "no inertial sample",
    "went back",
    "aligning again",
    "contradicted",
    "diverg",
    "lost",
    "watchdog",
)


def _notes(result: Result) -> Iterator[Finding]:
    """Tell the filter's notes of trouble; the others are listed with the outcomes."""
    alarming = [(t, n) for t, n in result.run.notes if any(w in n.lower() for w in _ALARMING)]
    for t_ns, text in alarming[:20]:
        yield Finding(
            Severity.WARNING,
            f"at {result.seconds(int(t_ns)):.1f} s: {text}",
            "inertial data or fixes were missing, or contradicted each other for long",
            "compare with the sensors' coverage and outcomes at that time",
        )
    if len(alarming) > 20:
        yield Finding(
            Severity.WARNING,
            f"{len(alarming) - 20} further notes of this kind from the filter",
            "as above",
            "as above",
        )


def _inputs(result: Result) -> Iterator[Finding]:
    present = {s.kind for s in result.streams}
    for kind, severity, consequence, remedy in _NEEDED:
        if kind not in present:
            name = kind.name.lower().replace("_", " ")
            yield Finding(severity, f"no {name} in the log", consequence, remedy)
    for s in result.streams:
        if s.kind is Kind.TIMESYNC:
            continue
        if s.kind is Kind.IMU and 0 < s.rate_hz < 45:
            yield Finding(
                Severity.WARNING,
                f"{s.name} comes at {s.rate_hz:.0f} Hz",
                "attitude and velocity lose accuracy below about 50 Hz",
                "raise the logging or streaming rate of the IMU",
            )
        if s.gaps:
            worst = s.longest_gap_s
            # A target out of sight, or a sensor that is not used, is no trouble.
            matters = s.kind is not Kind.VISION and s.name not in result.unused
            severe = matters and worst > (0.5 if s.kind is Kind.IMU else 5.0)
            yield Finding(
                Severity.WARNING if severe else Severity.NOTE,
                f"{s.name}: {_count(len(s.gaps), 'gap')}, the longest {worst:.2f} s",
                "messages were not logged, or lost on the link",
                "lower the logging load, use a faster card or link" if severe else "nothing, unless it grows",
            )
        if s.backwards:
            yield Finding(
                Severity.NOTE,
                f"{s.name}: {_count(s.backwards, 'stamp')} older than the one before",
                "late or re-ordered messages, or a clock that was set back",
                "inside the rewind window they are fused at their own time",
            )
    if result.vibration_mps2 is not None and result.vibration_mps2 > 3.0:
        yield Finding(
            Severity.WARNING,
            f"specific force scatters by {result.vibration_mps2:.1f} m/s² from sample to sample",
            "vibration of the airframe reaches the accelerometer",
            "balance the propellers, damp the autopilot's mount",
        )


def _outcomes(result: Result) -> Iterator[Finding]:
    cameras = {s.name for s in result.streams if s.kind is Kind.VISION}
    for sensor in result.measured:
        if sensor in result.unused:
            continue
        records = result.tried[result.tried["sensor"] == result.run.sensors.index(sensor)]
        total = len(records)
        for outcome, (cause, remedy) in _REMEDIES.items():
            n = int(np.count_nonzero(records["outcome"] == int(outcome)))
            harmless = outcome is Outcome.REJECTED_DUPLICATE and sensor not in cameras
            if n < 3 or n / total < (0.05 if harmless else 0.01):
                continue
            severity = Severity.NOTE if harmless else Severity.WARNING
            if n / total >= 0.5 and outcome not in (Outcome.REJECTED_DUPLICATE, Outcome.REJECTED_NOT_READY):
                severity = Severity.SERIOUS
            yield Finding(
                severity,
                f"{sensor}: {n} of {total} ({_percent(n / total)}) rejected: {EXPLANATIONS[outcome]}",
                cause,
                remedy,
            )


_TOO_LARGE = (
    "its noise is set too small, its latency or calibration is wrong, or it contradicts others",
    "raise its sigma, or find the offset in its innovations",
)
_TOO_LARGE_VISION = (
    "the camera's mount, focal length or latency is off, the fixes' stated covariance is too small, or the deck moves "
    "in a way that the model does not know",
    "deckfix calibrate the camera; set vision.mount_rpy_rad and vision.latency_s; where the innovations grow with "
    "height raise vision.angle_sigma_rad and range_sigma, where they do not vision.floor_m",
)


def _consistency(result: Result) -> Iterator[Finding]:
    for sensor in result.measured:
        statistics = result.nis(sensor)
        if statistics is None or statistics.count < 30:
            continue
        mean = statistics.mean_over_dof
        if mean > 2.0:
            cause, remedy = _TOO_LARGE_VISION if sensor.split("/")[0] == "vision" else _TOO_LARGE
            yield Finding(
                Severity.SERIOUS if mean > 6.0 else Severity.WARNING,
                f"{sensor}: innovations are {np.sqrt(mean):.1f} times larger than expected",
                cause,
                remedy,
            )
        elif mean < 0.2:
            yield Finding(
                Severity.NOTE,
                f"{sensor}: innovations are {1 / np.sqrt(max(mean, 1e-6)):.1f} times smaller than expected",
                "its noise is configured larger than it is",
                "lower its sigma to get more out of it",
            )
        yield from _offsets(result, sensor)
    errors = result.truth_errors
    if errors is not None and errors.nees_dof:
        inside = result.judged.inside(errors.t_ns) & np.isfinite(errors.nees)
        if np.count_nonzero(inside) >= 30:
            mean = float(np.mean(errors.nees[inside])) / errors.nees_dof
            if mean > 3.0:
                yield Finding(
                    Severity.WARNING,
                    f"errors against the truth are {np.sqrt(mean):.1f} times what the covariance says",
                    "errors that last longer than the filter assumes (GPS wander), or noise set too small",
                    "raise the noise of the sensor whose innovations are largest",
                )


def _offsets(result: Result, sensor: str) -> Iterator[Finding]:
    records = result.sensor_records(sensor)
    records = records[records["outcome"] <= int(Outcome.DOWNWEIGHTED)]
    if len(records) < 30:
        return
    with np.errstate(invalid="ignore", divide="ignore"):
        scaled = records["innovation"] / records["sigma"]
    for i in range(int(records["dof"].max())):
        column = scaled[:, i]
        column = column[np.isfinite(column)]
        if len(column) >= 30 and abs(float(np.median(column))) > 1.0:
            yield Finding(
                Severity.WARNING,
                f"{sensor}: innovation {i + 1} of {int(records['dof'].max())} is off by "
                f"{float(np.median(column)):+.1f} sigma throughout",
                "a constant error: datum, declination, mount, lever arm or latency",
                "calibrate the sensor, or set its offset in the configuration",
            )


def _biases(result: Result) -> Iterator[Finding]:
    if not len(result.run.t_ns):
        return
    gyro = float(np.rad2deg(np.abs(result.run.gyro_bias[-1]).max()))
    if gyro > 1.0:
        yield Finding(
            Severity.WARNING,
            f"the gyro bias ends at {gyro:.2f} deg/s",
            "the autopilot's gyro calibration is off, or the IMU had not warmed up",
            "let the IMU warm up and calibrate the gyros at rest",
        )
    accel = float(np.abs(result.run.accel_bias[-1]).max())
    if accel > 0.5:
        yield Finding(
            Severity.WARNING,
            f"the accelerometer bias ends at {accel:.2f} m/s²",
            "accelerometer calibration is off, or vibration is rectified",
            "repeat the autopilot's accelerometer calibration; look at vibration",
        )


def _uncertainty(result: Result) -> Iterator[Finding]:
    if not len(result.run.t_ns):
        return
    variance = np.einsum("nii->ni", result.run.covariance)[:, :3]
    if not np.isfinite(variance).all() or not np.isfinite(result.run.position_m).all():
        yield Finding(
            Severity.SERIOUS,
            "the estimate is not finite",
            "the filter diverged",
            "this is a defect: please report it with the log",
        )
        return
    fastest = float(np.linalg.norm(result.run.velocity_mps, axis=1).max())
    if fastest > 150.0:
        yield Finding(
            Severity.SERIOUS,
            f"the estimate moves at up to {fastest:.0f} m/s, which no multirotor does",
            "impossible inertial samples or positions in the log",
            "look for the moment in the plots, and cut the log before or after it",
        )
    worst = float(np.sqrt(variance.max(axis=1).clip(0.0)).max())
    if worst > 20.0:
        yield Finding(
            Severity.WARNING,
            f"position was uncertain by up to {worst:.0f} m (1 sigma)",
            "no position was fused for a while",
            "see which sensor fell silent, and when",
        )


def _messages(result: Result) -> Iterator[Finding]:
    errors = [m for m in result.messages if m.level >= 40]
    for message in errors[:10]:
        yield Finding(
            Severity.NOTE,
            f"at {result.seconds(message.t_ns):.1f} s {message.source or 'autopilot'} said: {message.text}",
            "the autopilot's own message of level error or above",
            "see the autopilot's documentation",
        )
    if len(errors) > 10:
        yield Finding(
            Severity.NOTE,
            f"{len(errors) - 10} further error messages of the autopilot",
            "as above",
            "deckfix export writes all of them (topic /log)",
        )
