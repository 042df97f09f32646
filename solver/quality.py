"""What a run says about its own trustworthiness."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class QualityReport:
    """Quality of the samples computed so far.

    Attributes:
        samples: number of samples.
        equilibrium_residual: largest |F - law(compression)| over all wheelsets and steps, divided
            by the static wheelset load (-).
        energy_residual: |work done - stored - dissipated| of the line, per work done or energy (-);
            with exponential steps only when asked for (``balance``), else None.
        lost_contacts: number of times a wheelset on the line lifted off; with the linear law, times
            the force became tensile.
        valid_band: highest trustworthy frequency of every channel (Hz).
        notes: sentences on what limits the result.
    """

    samples: int
    equilibrium_residual: float
    energy_residual: float | None
    lost_contacts: int
    valid_band: dict[str, float]
    notes: tuple[str, ...] = field(default=())
