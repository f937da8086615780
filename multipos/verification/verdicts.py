"""Verdicts: the result of `multipos.check`, and its file.

Errors e of K quantities at n rows before and after compensation, with the expanded uncertainty U of
the latter. Against a limit L, U is the guard band:

    pass where |e| + U <= L,    fail where |e| − U > L,    else undecided.                  (1)
"""

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from multipos.errors import MultiposError
from multipos.files.formats import CHECK
from multipos.files.records import require
from multipos.files.tables import read_json, to_json, write_text
from multipos.numerics.arrays import Array
from multipos.results import Result

SCHEMA = "multipos/check/1"
_BY_AXIS = ("reference", "before", "after", "u", "U", "counted", "by_axis")
VERDICTS = ("pass", "undecided", "fail")  # from best to worst


@dataclass(frozen=True, eq=False)
class Check(Result):
    """Errors of K axes at n positions, before and after compensation.

    Of a regression the one axis is its response, and the positions are the rows of a table.

    Attributes
    ----------
    quantity, unit : str
        'force' in g or 'tilt' in degrees; of a regression its response, in g where a limit says so
        and else without a unit.
    axes : tuple of K str
    positions : tuple of n str
    reference, before, after, u, U : (n, K) arrays
        What is known, the errors, and the uncertainty of `after`; `after` is NaN where no tilt
        explains the reading. Of a regression the reference is the variable `against`.
    limit : float or None
    verdicts : (n, K) array of str
        By eq. (1); empty without a limit and where `counted` is false.
    counted : (n, K) array of bool
        Positions within `within` of level, or rows inside what a regression was fitted to, which
        the summary and the verdict are about.
    linearity_percent : {'before': (K,) array, 'after': (K,) array}
    bias, scale : float or None
        The nominal conversion; a regression has none.
    confidence : float
    source, sha256 : str or None
    warnings : tuple of str
    calibration : str or None
        When the calibration or regression was made, which tells it from others.
    against : str or None
    segments : mapping of str to (n,) array of bool
        The rows of every segment of a regression.
    """

    quantity: str
    unit: str
    axes: tuple[str, ...]
    positions: tuple[str, ...]
    reference: Array
    before: Array
    after: Array
    u: Array
    U: Array
    limit: float | None
    verdicts: NDArray[np.str_]
    counted: NDArray[np.bool_]
    linearity_percent: Mapping[str, Array]
    bias: float | None
    scale: float | None
    confidence: float
    source: str | None = field(compare=False)
    sha256: str | None
    warnings: tuple[str, ...]
    calibration: str | None = field(default=None, compare=False)
    against: str | None = None
    segments: Mapping[str, NDArray[np.bool_]] = field(default_factory=dict)

    @property
    def verdict(self) -> str | None:
        """The worst verdict of all positions, or None without a limit."""
        return worst(self.verdicts)

    def summary(self, axis: str | None = None, segment: str | None = None) -> dict[str, Any]:
        """Return maximum, rms and linearity before and after, of one axis or segment or of all."""
        columns = [self.axes.index(axis)] if axis else list(range(len(self.axes)))
        counted = self.counted
        if segment is not None:
            counted = counted & self.segments[segment][:, None]
        found: dict[str, Any] = {}
        for when, errors in (("before", self.before), ("after", self.after)):
            part = errors[:, columns][counted[:, columns]]
            part = part[np.isfinite(part)]
            found[when] = {
                "maximum": float(np.abs(part).max()) if len(part) else np.nan,
                "rms": float(np.sqrt(np.mean(part**2))) if len(part) else np.nan,
                "linearity_percent": float(self.linearity_percent[when][columns].max()),
            }
        widest = np.where(counted, self.U, -np.inf)[:, columns]
        found["after"]["largest_U"] = float(widest.max())
        found["verdict"] = worst(np.where(counted, self.verdicts, "")[:, columns])
        return found

    def to_dict(self) -> dict[str, Any]:
        """Return everything as JSON carries it, keys as in docs/reference/check-and-tumble.md."""
        rows = []
        for row, label in enumerate(self.positions):
            entry: dict[str, Any] = {"position": label}
            for name in ("reference", "before", "after", "u", "U"):
                entry[name] = dict(zip(self.axes, getattr(self, name)[row].tolist(), strict=True))
            entry["verdict"] = worst(self.verdicts[row])
            entry["counted"] = dict(zip(self.axes, self.counted[row].tolist(), strict=True))
            rows.append(entry)
        return {
            "schema": SCHEMA,
            "input": {"file": self.source, "sha256": self.sha256},
            "calibration": self.calibration,
            "quantity": self.quantity,
            "against": self.against,
            "unit": self.unit or None,
            "limit": self.limit,
            "confidence": self.confidence,
            "nominal": None if self.bias is None else {"bias": self.bias, "scale": self.scale},
            "axes": self.axes,
            "positions": rows,
            **self.summary(),
            "by_axis": {axis: self.summary(axis) for axis in self.axes},
            "by_segment": {
                name: {"rows": int(rows.sum()), **self.summary(segment=name)}
                for name, rows in self.segments.items()
            },
            "warnings": self.warnings,
        }

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the check as JSON, whole or not at all."""
        write_text(path, to_json(self.to_dict()))


def load_check(path: str | os.PathLike[str]) -> Check:
    """Read a check of a calibration written by `Check.save`.

    Raises
    ------
    MultiposError
        The file is missing, truncated, of another schema or of a regression, or holds what no
        check does.
    """
    content = read_json(path, SCHEMA)
    if content.get("against") is not None:
        raise MultiposError(
            f"{path}: the check of a regression; a report of a calibration needs a check of it."
        )
    require(content, CHECK, str(path), "run check again")
    axes = set(content["axes"])
    for row in [*content["positions"], {"by_axis": content["by_axis"]}]:
        for key, entry in row.items():
            if key in _BY_AXIS and set(entry) != axes:
                raise MultiposError(
                    f"{path}: not a check: '{key}' is of {', '.join(entry)}, not of its axes; run "
                    "check again."
                )
    return _from_dict(content)


def _from_dict(c: Mapping[str, Any]) -> Check:
    axes = tuple(c["axes"])

    def column(name: str) -> Array:
        rows = [[row[name][axis] for axis in axes] for row in c["positions"]]
        return np.array(rows, dtype=np.float64).reshape(len(rows), len(axes))

    after, U, counted = column("after"), column("U"), column("counted").astype(bool)
    linearity = {
        when: np.array(
            [c["by_axis"][axis][when]["linearity_percent"] for axis in axes], dtype=np.float64
        )
        for when in ("before", "after")
    }
    return Check(
        quantity=c["quantity"],
        unit=c["unit"],
        axes=axes,
        positions=tuple(row["position"] for row in c["positions"]),
        reference=column("reference"),
        before=column("before"),
        after=after,
        u=column("u"),
        U=U,
        limit=c["limit"],
        verdicts=judge(after, U, c["limit"], counted),
        counted=counted,
        linearity_percent=linearity,
        bias=c["nominal"]["bias"],
        scale=c["nominal"]["scale"],
        confidence=c["confidence"],
        source=c["input"]["file"],
        sha256=c["input"]["sha256"],
        warnings=tuple(c["warnings"]),
        calibration=c["calibration"],
    )


def judge(
    after: Array, U: Array, limit: float | None, counted: NDArray[np.bool_]
) -> NDArray[np.str_]:
    """Return the verdicts of eq. (1); empty without a limit and where nothing counts."""
    verdicts = np.full(after.shape, "", dtype="<U9")
    if limit is None:
        return verdicts
    error = np.abs(after)
    verdicts[:] = "undecided"
    verdicts[error + U <= limit] = "pass"
    verdicts[(error - U > limit) | np.isnan(after)] = "fail"
    verdicts[~counted] = ""
    return verdicts


def worst(verdicts: NDArray[np.str_]) -> str | None:
    """Return the worst of some verdicts, None where there is none."""
    given = [VERDICTS.index(name) for name in set(verdicts.ravel().tolist()) if name]
    return VERDICTS[max(given)] if given else None
