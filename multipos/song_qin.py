"""The six-position paper's own readings, and what becomes of them: ``multipos demo``.

`demo` calibrates the paper's readings, `demo_text` prints what came of it, and `demo_dict` is its
JSON.

Table 2 of the paper is calibrated by its closed form and by least squares, each coefficient is
set beside the one printed, and what the closed form does not say is said: six readings and five
coefficients an axis leave one contrast, and with it one degree of freedom.

References
----------
Song Lijun, Qin Yongyuan, *Six-position testing of MEMS accelerometer*, Measurement & Control
Technology 28 (7), 2009, 11–13 (in Chinese): tables 1 and 2, eqs. (2)–(5).
"""

from pathlib import Path
from typing import Any

import numpy as np

from multipos.files.numbers import number, table
from multipos.files.spelling import StrPath
from multipos.files.tables import Column, write_table
from multipos.files.trees import to_json
from multipos.files.whole import make_folder, write_text
from multipos.fitting.fit_readings import fit
from multipos.numerics.arrays import Mask
from multipos.positions.readings import Readings
from multipos.reports.summary import text_report
from multipos.results import Result, frozen
from multipos.sensor.calibration import Calibration

_PUBLISHED = np.loadtxt(Path(__file__).with_name("song_qin.csv"), delimiter=",")
TABLE_2 = _PUBLISHED[:6]  # outputs of the x, y and z accelerometers [g] at the positions of table 1
PRINTED = _PUBLISHED[6:].T  # below eq. (4), in the order of the model: 1, x, y, z, own²
_LAST_DIGIT = 1e-11  # the printed figures that follow from table 2 agree to their last digit


@frozen
class Demonstration(Result):
    """Table 2 calibrated by least squares and by the closed form."""

    calibration: Calibration
    closed_form: Calibration

    def __str__(self) -> str:
        return demo_text(self).rstrip("\n")


def demo(folder: StrPath | None = None) -> Demonstration:
    """Calibrate table 2 of the six-position paper; write readings, calibration and report.

    Parameters
    ----------
    folder : path, optional
        Where to write ``readings.csv``, ``calibration.json`` and ``report.txt``; it is made if
        it is not there. Without it nothing is written.

    Returns
    -------
    Demonstration

    Examples
    --------
    >>> import multipos as mp
    >>> found = mp.demo()
    >>> scale = found.calibration["scale_ax"]
    >>> print(f"{scale.value:.5f} {scale.unit}, U = {scale.U:.4f}")
    0.99647 1, U = 0.0094
    """
    readings = Readings(TABLE_2, unit="g", positions=tuple("123456"))
    least_squares, closed_form = (
        fit(
            readings,
            scheme="song-qin-6",
            model="own-quadratic",
            convention="gravity",
            closed_form=closed,
        )
        for closed in (False, True)
    )
    found = Demonstration(least_squares, closed_form)
    if folder is not None:
        _write(Path(folder), found)
    return found


def demo_text(found: Demonstration) -> str:
    """Return the demonstration as text: the coefficients side by side, and what they hide."""
    header = ["", "parameter", "printed", "closed form", "least squares", "u", "U (95 %)"]
    rows = [
        [
            each["symbol"] or "",
            each["name"],
            _as_printed(each["printed"]),
            *(f"{each[route]:.11f}" for route in ("closed_form", "least_squares")),
            *(number(each[key], 2) for key in ("u", "U")),
        ]
        for each in _coefficients(found)
    ]
    return (
        "Table 2 of Song and Qin (2009), six positions, model own-quadratic [g]\n\n"
        f"{table(header, rows, left=2)}\n\n{_remarks(found)}"
    )


def _as_printed(value: float) -> str:
    """Return the digits of the paper, without zeros after them, the points below each other."""
    text = f"{value:.11f}"
    return text.rstrip("0").ljust(len(text))


def demo_dict(found: Demonstration) -> dict[str, object]:
    """Return the demonstration as what JSON can carry."""
    c = found.calibration
    return {
        "coefficients": _coefficients(found),
        "calibration": c.to_dict(),
        "findings": [each.to_dict() for each in c.findings],
    }


def _coefficients(found: Demonstration) -> list[dict[str, Any]]:
    """Return each coefficient as printed and by both routes."""
    columns = (PRINTED.ravel(), found.closed_form.parameters, _agrees(found))
    return [
        {
            **{key: getattr(p, key) for key in ("output", "term", "name", "symbol")},
            "printed": printed,
            "closed_form": closed,
            "least_squares": p.value,
            "u": p.u,
            "U": p.U,
            "agrees": agrees,
        }
        for p, printed, closed, agrees in zip(
            found.calibration.entries, *(column.tolist() for column in columns), strict=True
        )
    ]


def _agrees(found: Demonstration) -> Mask:
    result: Mask = np.abs(PRINTED.ravel() - found.closed_form.parameters) < _LAST_DIGIT
    return result


def _remarks(found: Demonstration) -> str:
    c = found.calibration
    p_scale, p_quad, p_bias = c["ay", "y"], c["ay", "y^2"], c["ay", "1"]
    agrees = _agrees(found)
    pattern = float(np.abs(c.residuals[:, 1]).max())
    # rounding, which is another on every processor
    apart = f"{c.cross_check:.1e}" if (c.cross_check or 0.0) > 1e-15 else "less than 1e-15"
    return (
        f"{int(agrees.sum())} of {len(agrees)} printed figures follow from the printed table. "
        "Two do not:\n"
        f"  S_ay   is printed {PRINTED[1, 2]:.9f}, which is -A_y1; "
        f"the formula gives {p_scale.value:.9f}.\n"
        f"  K_ay3  is off by {abs(PRINTED[1, 4] - p_quad.value):.1e}, "
        "because A_y4 was rounded to 1.003011 in print.\n"
        f"Closed form and least squares differ by {apart} of the largest reading.\n\n"
        "What the closed form hides: six readings and five coefficients an axis leave one\n"
        f"contrast. On y it is a residual pattern of +-{pattern * 1e3:.2f} mg "
        f"(s = {float(c.residual_sd[1]) * 1e3:.1f} mg), and with one\n"
        f"degree of freedom (k = {p_bias.k:.2f}) the bias a_y0 = {p_bias.value * 1e3:.2f} mg "
        f"has U = {p_bias.U * 1e3:.0f} mg.\n\n"
        "The paper's text lists positions 4 and 6 in the other order than its table 1; the table\n"
        "agrees with the equations and is used here.\n"
    )


def _write(folder: Path, found: Demonstration) -> None:
    make_folder(folder)
    c = found.calibration
    columns: dict[str, Column] = {"position": c.readings.positions or ()}
    columns |= {output: TABLE_2[:, i] for i, output in enumerate(c.outputs)}
    write_table(folder / "readings.csv", columns)
    write_text(folder / "calibration.json", to_json(c.to_dict()))
    write_text(folder / "report.txt", f"{demo_text(found)}\n{text_report(c)}")
