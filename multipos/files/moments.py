"""The time that results carry."""

import os
from datetime import UTC, datetime


def now() -> str:
    """Return the time in UTC; SOURCE_DATE_EPOCH, where set, makes results reproducible."""
    epoch = os.environ.get("SOURCE_DATE_EPOCH")
    moment = datetime.now(UTC) if epoch is None else datetime.fromtimestamp(int(epoch), UTC)
    return moment.isoformat(timespec="seconds")
