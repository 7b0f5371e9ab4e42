"""The closed list of outcomes that every fusion attempt ends in.

The same list is used by the filter, the log (``/fusion``), the report and the live output, so that a rejection
is explained by one word wherever it is met.
"""

from enum import IntEnum


class Outcome(IntEnum):
    """What became of one measurement. The integer is what the log stores."""

    FUSED = 0
    """Fused at its own time, in order of arrival."""
    FUSED_LATE = 1
    """Fused at its own time, after the filter was rewound to it."""
    DOWNWEIGHTED = 2
    """Fused with an inflated covariance (Huber): suspicious, but not impossible."""
    REJECTED_GATE = 3
    """The innovation is outside the chi-square gate."""
    REJECTED_NOT_FINITE = 4
    """NaN or infinity in the values or in their covariance."""
    REJECTED_COVARIANCE = 5
    """The covariance is not symmetric positive definite, or is worse than the sensor's configured limit."""
    REJECTED_TOO_OLD = 6
    """Older than the rewind window."""
    REJECTED_FUTURE = 7
    """Further ahead of the inertial clock than the window allows."""
    REJECTED_DUPLICATE = 8
    """Same sensor, same stamp and same content as one that was already taken; or a vision fix that shows to the last
    bit what the one before it shows, under a new stamp (a picture that stands still)."""
    REJECTED_NOT_READY = 9
    """The filter is not initialised, the sensor says that it has no valid reading, or it is switched off."""

    @property
    def fused(self) -> bool:
        """True where the measurement changed the estimate."""
        return self <= Outcome.DOWNWEIGHTED


EXPLANATIONS: dict[Outcome, str] = {
    Outcome.FUSED: "fused at its own time",
    Outcome.FUSED_LATE: "arrived late; fused at its own time by rewinding",
    Outcome.DOWNWEIGHTED: "innovation unlikely; fused with less weight",
    Outcome.REJECTED_GATE: "innovation outside the gate",
    Outcome.REJECTED_NOT_FINITE: "values are not finite",
    Outcome.REJECTED_COVARIANCE: "covariance not usable or worse than the limit",
    Outcome.REJECTED_TOO_OLD: "older than the rewind window",
    Outcome.REJECTED_FUTURE: "ahead of the inertial clock",
    Outcome.REJECTED_DUPLICATE: "same measurement again",
    Outcome.REJECTED_NOT_READY: "filter or sensor not ready, or switched off",
}
