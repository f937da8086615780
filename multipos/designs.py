"""What a scheme of positions can tell about a model: information, and what stays unknown.

With the design X_i (n, p_i) of output i at the positions of a scheme and readings of unit
standard uncertainty, the information per position is M_i = X_i'X_i/n, and

    log_det = sum_i ln det M_i,      u_j = sqrt([(X_i'X_i)^-1]_jj),                         (1)

so u_j is the standard uncertainty of parameter j for a reading of standard uncertainty 1.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from multipos.errors import UsageError
from multipos.files import Source
from multipos.formatting import number, table
from multipos.known import FLOOR
from multipos.least_squares import name_combinations, separability
from multipos.model import COMPONENTS, Model, build_model, default_axes
from multipos.scheme import Scheme, named_schemes, read_scheme

Array = NDArray[np.float64]


def schemes(
    *sources: "Source | Scheme",
    model: str = "linear",
    axes: Sequence[str] | str = COMPONENTS,
    inputs: Sequence[str] | str = COMPONENTS,
    reading_sd: float = 1.0,
) -> dict[str, Any]:
    """Return what schemes can tell about a model: all named ones, or those given.

    Parameters
    ----------
    *sources : names, joined names, paths, columns or Scheme
    model : str
        Name or formula.
    axes, inputs : sequences of str, or comma-separated str
        As in `multipos.fit`; outputs are named ax, ay, az after their axes.
    reading_sd : float
        Standard uncertainty of a reading, for the predicted u.

    Returns
    -------
    dict
        {"model", "schemes": [{name, positions, identifiable, unidentifiable, log_det,
        condition, u}]}; log_det and u are None where the model is not identifiable.
    """
    if not reading_sd > 0.0:
        raise UsageError(f"--reading-sd must be above 0, got {reading_sd}.")
    names = default_axes((), axes)
    outputs = tuple(f"a{axis}" for axis in names)
    seen = tuple(inputs.split(",")) if isinstance(inputs, str) else tuple(inputs)
    built = build_model(model, outputs, names, seen, known=())
    given = [read_scheme(source) for source in sources or named_schemes()]
    return {
        "model": built.text,
        "schemes": [_describe(scheme, built, reading_sd) for scheme in given],
    }


def _describe(scheme: Scheme, model: Model, reading_sd: float) -> dict[str, Any]:
    phi = model.basis(scheme.up, {})
    unidentifiable: list[str] = []
    log_det, condition, u = 0.0, 1.0, {}
    for output, (part, columns) in enumerate(zip(model.slices, model.columns, strict=True)):
        design = phi[:, columns]
        found = separability(design, floor=FLOOR)
        if found.rank < found.parameters:
            unidentifiable += name_combinations(found.null, model.names[part])
            continue
        condition = max(condition, found.condition)
        factor = np.linalg.qr(design, mode="r")
        log_det += 2.0 * float(np.log(np.abs(np.diag(factor))).sum())
        log_det -= len(columns) * float(np.log(len(design)))
        spread = np.linalg.norm(np.linalg.inv(factor), axis=1) * reading_sd
        for term, value in zip(model.terms[output], spread.tolist(), strict=True):
            u[f"{model.outputs[output]}:{term}"] = value
    sound = not unidentifiable
    return {
        "name": scheme.name,
        "positions": len(scheme),
        "up": dict(
            zip(
                scheme.labels or map(str, range(1, len(scheme) + 1)),
                scheme.up.tolist(),
                strict=True,
            )
        ),
        "identifiable": sound,
        "unidentifiable": unidentifiable,
        "log_det": log_det if sound else None,
        "condition": condition if sound else None,
        "u": u if sound else None,
    }


def schemes_text(found: dict[str, Any]) -> str:
    """Return `schemes` as text: one table, and for a single scheme its u and what it hides."""
    header = ["scheme", "positions", "identifiable", "log det", "condition", "largest u"]
    rows = [
        [
            entry["name"],
            str(entry["positions"]),
            "yes" if entry["identifiable"] else "no",
            number(entry["log_det"], 6),
            number(entry["condition"], 3),
            number(max(entry["u"].values()) if entry["u"] else None, 3),
        ]
        for entry in found["schemes"]
    ]
    parts = [f"model {found['model']}", table(header, rows)]
    if len(found["schemes"]) == 1:
        entry = found["schemes"][0]
        up = [[label, *(f"{value:.6g}" for value in row)] for label, row in entry["up"].items()]
        parts.append(table(["position", "up x", "up y", "up z"], up))
        if entry["u"]:
            u = [[*key.split(":", 1), number(value)] for key, value in entry["u"].items()]
            parts.append(table(["output", "term", "u"], u, left=2))
        parts += entry["unidentifiable"]
    return "\n\n".join(parts) + "\n"
