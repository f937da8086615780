"""A fleet as the command prints it.

- `fleet_sentence` returns yield and verdicts as a sentence, `fleet_text` the tables.
- `parameter_rows`, `station_rows`, `cause_rows`, `limit_rows`, `outlier_rows`, `drift_rows` are
  their rows, of which the page is made as well; `percent` writes a share.
"""

import re
from collections.abc import Mapping, Sequence
from typing import Any

from multipos.files.numbers import (
    chance,
    decimals_of,
    number,
    plain_number,
    readable_unit,
    table,
    uncertain,
)

_REASONS = 3  # that the first line names
_SHOWN = 10  # outliers, causes and moves that are listed


def fleet_text(found: Mapping[str, Any]) -> str:
    """Return the summary of a fleet, as `fleet.json` holds it, as text."""
    parts = [] if found["asked"]["unit_column"] else ["each file is one unit, named by the file"]
    parts.append(_table("Parameters", *parameter_rows(found)))
    if len(found["stations"]) > 1:
        parts.append(_table("Stations, against their mean", *station_rows(found)))
    for title, (header, rows) in (
        ("Why units do not pass", cause_rows(found)),
        ("Units outside their limits", limit_rows(found)),
        ("Units that do not belong", outlier_rows(found)),
        ("What moved", drift_rows(found)),
    ):
        if rows:
            more = f" (the first {_SHOWN} of {len(rows)})" if len(rows) > _SHOWN else ""
            parts.append(_table(f"{title}{more}", header, rows[:_SHOWN]))
    return "\n\n".join(parts) + "\n"


def percent(share: float) -> str:
    """Return a share in percent."""
    return f"{100.0 * share:.2f} %"


def _table(title: str, header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    return f"{title}\n{table(header, rows)}"


Rows = tuple[tuple[str, ...], Sequence[tuple[str, ...]]]


def parameter_rows(found: Mapping[str, Any]) -> Rows:
    """Return how every parameter spreads over the line."""
    header = ("parameter", "unit", "mean", "sd", "sd of units", "lsl", "usl", "Cpk", "Ppk")
    rows = [
        (
            each["name"],
            *_spread(each),
            *(_interval(each[key]) for key in ("cpk", "ppk", "ppk_true")),
        )
        for each in found["parameters"]
    ]
    return (*header, "Ppk of units"), rows


def _spread(each: Mapping[str, Any]) -> tuple[str, ...]:
    """Return unit, mean, both sds and both limits of a parameter, in a unit that people read."""
    factor, unit = readable_unit(max(abs(each["mean"] or 0.0), each["sd"] or 0.0), each["unit"])
    mean, *others = (
        None if each[key] is None else factor * each[key]
        for key in ("mean", "sd", "sd_true", "lsl", "usl")
    )
    decimals = decimals_of(others[0] or 0.0)
    mean_text = (
        plain_number(mean) if mean is None or decimals is None else f"{mean:.{decimals + 1}f}"
    )
    sd, sd_true, low, high = others
    return unit, mean_text, plain_number(sd), plain_number(sd_true), number(low), number(high)


def _interval(figure: Mapping[str, float] | None) -> str:
    if figure is None:
        return "-"
    return f"{figure['value']:.2f} [{figure['low']:.2f}, {figure['high']:.2f}]"


def station_rows(found: Mapping[str, Any]) -> Rows:
    """Return the level and the shift of every station."""
    first = found["stations"][0]
    turned = list(first["level_deg"] or ())
    shifted = list(first["shift"] or ())
    header = (
        "station",
        "units",
        *(f"level {axis} [°]" for axis in turned),
        *(f"shift {output}" for output in shifted),
    )
    rows = [
        (
            each["station"] or "-",
            str(each["units"]),
            *(_uncertain((each["level_deg"] or {}).get(axis)) for axis in turned),
            *(_uncertain((each["shift"] or {}).get(output)) for output in shifted),
        )
        for each in found["stations"]
    ]
    off = ["; ".join(map(_off, each.get("findings", ()))) for each in found["stations"]]
    if any(off):
        header, rows = (*header, "off"), [(*row, said) for row, said in zip(rows, off, strict=True)]
    return header, rows


def _off(said: Mapping[str, Any]) -> str:
    """Return what is off of a station, without its name."""
    what, _, size = str(said["text"]).partition(" is off by ")
    return f"{re.split(' (?:of|at) station ', what)[0]} by {size.partition(' (u')[0]}"


def _uncertain(figure: Mapping[str, float] | None) -> str:
    return "-" if figure is None else uncertain(figure["value"], figure["u"])


def cause_rows(found: Mapping[str, Any]) -> Rows:
    """Return why units do not pass, the commonest cause first, each with its first unit."""
    first = found.get("first", {})  # not of version 0.2
    rows = [(cause, str(count), first.get(cause, "-")) for cause, count in found["causes"].items()]
    return ("cause", "units", "first"), rows


def limit_rows(found: Mapping[str, Any]) -> Rows:
    """Return the units that are outside their limits."""
    rows = [
        (each["unit"], each["station"] or "-", each["reason"]) for each in found.get("outside", ())
    ]
    return ("unit", "station", "what"), rows


def outlier_rows(found: Mapping[str, Any]) -> Rows:
    """Return the units that do not belong to the others, the farthest first."""
    header = ("unit", "station", "T^2", "p", "what is farthest, in standard deviations")
    rows = [
        (
            each["unit"],
            each["station"] or "-",
            number(each["statistic"]),
            chance(each["p"]),
            ", ".join(f"{p['name']} {p['deviation']:+.1f}" for p in each["parameters"]),
        )
        for each in found["outliers"]
    ]
    return header, rows


def drift_rows(found: Mapping[str, Any]) -> Rows:
    """Return what moved, the surest first."""
    header = ("parameter", "station", "move", "by", "from unit", "p")
    rows = [
        (
            each["name"],
            each["station"] or "-",
            each["kind"],
            uncertain(each["value"], each["u"]),
            each["from_unit"],
            chance(each["p"]),
        )
        for each in found["drift"]
    ]
    return header, rows


def fleet_sentence(found: Mapping[str, Any]) -> str:
    """Return the yield, units by verdict, the largest reasons, stations that are off, outliers."""
    good = found["yield"]
    low, high = (f"{100.0 * good[side]:.2f}" for side in ("low", "high"))
    counts = ", ".join(f"{count} {name}" for name, count in found["verdicts"].items())
    reasons = [f"{cause} {count}" for cause, count in found["causes"].items()]
    off = [each["station"] for each in found["stations"] if each.get("findings")]
    where = "fixture off" if off and not any(off) else _first("stations off", off)
    outliers = _first("outliers", [str(each["unit"]) for each in found["outliers"]])
    said = "; ".join(filter(None, [counts, _first("why", reasons), where, outliers]))
    return (
        f"Yield {100.0 * good['value']:.2f} % ({low} to {high} % with 95 % confidence) of "
        f"{found['units']} units: {said}."
    )


def _first(what: str, names: list[str]) -> str:
    """Return what is said of the first names, and how many more there are."""
    more = [f"{len(names) - _REASONS} more"] if len(names) > _REASONS else []
    return f"{what}: {', '.join([*names[:_REASONS], *more])}" if names else ""
