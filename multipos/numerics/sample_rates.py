"""Sample rates that a log may have."""

from multipos.errors import UsageError

SLOWEST, FASTEST = 1e-12, 1e7  # [Hz]


def require_rate(rate: float) -> None:
    """Refuse a rate [Hz] out of range.

    Raises
    ------
    UsageError
        The message begins with the option.
    """
    if not SLOWEST <= rate <= FASTEST:
        raise UsageError(
            f"--rate must be above 0, from {SLOWEST:g} to {FASTEST:g} Hz, got {rate:g}."
        )
