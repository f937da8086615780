"""A design as a result: its positions with the proof, as text, as a scheme file, and as a sheet."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from multipos.designs.assessment import Assessment, scheme_details
from multipos.files.numbers import table
from multipos.files.tables import format_csv
from multipos.numerics.arrays import Array
from multipos.numerics.terms import COMPONENTS
from multipos.results import Drawn, Keyed, Tabular


@dataclass(frozen=True, eq=False)
class Design(Keyed, Drawn, Tabular):
    """The best positions for a model on a bench, with the proof.

    Attributes
    ----------
    model, orientation, criterion : str
    positions : (n, 3) array
        Unit vectors pointing up: included ones first, the others in an order short to travel.
    included : int
    log_det, optimum_log_det : float
        Of these positions, and of the D-optimum on the sphere.
    efficiency : float
        Against the best on the whole sphere.
    certificate : mapping
        {max_variance, parameters, gap, over: 'sphere' or 'candidates'} of the best that could be.
    optimum : mapping
        {positions, weights} of the best that could be.
    bench_efficiency : float or None
        Against the best on the candidates; None for criterion G.
    travel_deg : float
    time_s : float or None
    scheme : Assessment
        What the positions tell.
    settings : tuple of mappings
        How the bench that was given is set at each position, in its own words; empty where it has
        none (`multipos.positions.bench_settings`).
    """

    model: str
    orientation: str
    criterion: str
    positions: Array
    included: int
    log_det: float | None
    optimum_log_det: float
    efficiency: float
    certificate: Mapping[str, Any]
    optimum: Mapping[str, Any]
    bench_efficiency: float | None
    travel_deg: float
    time_s: float | None
    scheme: Assessment
    settings: tuple[Mapping[str, Any], ...] = ()

    @property
    def labels(self) -> tuple[str, ...]:
        """The label that the bench gives each position, told apart where one comes again."""
        labels: list[str] = []
        for place in range(len(self.positions)):
            setting = self.settings[place] if self.settings else {}
            label = str(setting.get("position", place + 1))
            again = 2
            while label in labels:
                label = f"{setting.get('position', place + 1)} ({again})"
                again += 1
            labels.append(label)
        return tuple(labels)

    def columns(self) -> dict[str, Any]:
        """Return the positions as the columns of a scheme file, those of the bench behind them."""
        up = {f"up_{axis}": self.positions[:, i] for i, axis in enumerate(COMPONENTS)}
        bench = {f"bench_{n}": [str(s.get(n, "")) for s in self.settings] for n in self._set_by}
        return {"position": list(self.labels), **up, **bench}

    @property
    def _set_by(self) -> tuple[str, ...]:
        """What the bench is set by, as the settings name it."""
        return tuple(dict.fromkeys(n for s in self.settings for n in s if n != "position"))


def design_text(found: Design) -> str:
    """Return `design` as text: the positions, what they tell, and the certificate."""
    rows = [
        [str(i + 1), *(f"{value:.6f}" for value in up), "given" if i < found.included else ""]
        for i, up in enumerate(found.positions.tolist())
    ]
    if not found.included:
        rows = [row[:-1] for row in rows]
    header = ["position", "up x", "up y", "up z", ""][: len(rows[0])]
    heading = (
        f"model {found.model}, orientations {found.orientation}, "
        f"criterion {found.criterion}, {len(rows)} positions"
    )
    parts = [heading, table(header, rows), _summary(found), *scheme_details(found.scheme)]
    if found.settings:
        parts.append(_operators_sheet(found))
    return "\n\n".join(parts) + "\n"


def _operators_sheet(found: Design) -> str:
    """Return what to set at each position, with the axes' angles above the horizon to check it."""
    names = found._set_by
    rows = []
    for label, setting, up in zip(found.labels, found.settings, found.positions, strict=True):
        above = np.degrees(np.arcsin(np.clip(up, -1.0, 1.0)))
        angles = [f"{angle + 0.0:.1f}" for angle in above.tolist()]
        rows.append([label, *(_as_set(setting.get(name)) for name in names), *angles, "[ ]"])
    header = ["position", *names, *(f"{axis} above level" for axis in COMPONENTS), "done"]
    return f"operator's sheet, angles in degrees\n{table(header, rows)}"


def _as_set(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _summary(found: Design) -> str:
    """Return how good the positions are, with the certificate."""
    certificate = found.certificate
    bench = certificate["over"] == "candidates"
    reach = "these candidates" if bench else "the whole sphere"
    time = "" if found.time_s is None else f"{found.time_s:.0f} s"
    proof = (
        f"largest variance {certificate['max_variance']:.8g} of the best on {reach} "
        f"for {certificate['parameters']} parameters, less 1"
    )
    lines = [
        ["efficiency", f"{found.efficiency:.6f}", "against the best on the whole sphere"],
        ["log det", f"{found.log_det:.6f}", f"at most {found.optimum_log_det:.6f}"],
        ["certificate", f"{certificate['gap']:.1e}", proof],
        ["travel", f"{found.travel_deg:.0f}°", time],
    ]
    if bench and found.bench_efficiency is not None:
        share = f"{found.bench_efficiency:.6f}"
        lines.insert(1, ["", share, "against the best on these candidates"])
    width = max(len(line[1]) for line in lines)
    return "\n".join(f"{a:<11}  {b:>{width}}  {c}".rstrip() for a, b, c in lines)


def design_csv(found: Design) -> str:
    """Return the positions of a design as a scheme file."""
    return format_csv(found.columns())
