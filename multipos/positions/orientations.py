"""Where the sensor stood, resolved: listed, uncertain, unknown, in groups, on a tilted table.

Readings, a scheme and options together say, position by position, where the reference should be and
how far it may be from there. `orient` takes the directions of a scheme, `without_orientation` none,
and `place` gathers what is known once, as `StatedOrientations`; what follows asks no more.
`listed_rows` and `are_samples` tell kinds of rows, `as_used` says what was used of them.

A standard deviation of zero is a position known exactly, an infinite one a position of which
nothing is known, in every type.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from multipos.errors import MultiposError
from multipos.files.spelling import near, quoted
from multipos.files.tables import Source
from multipos.finding import Finding
from multipos.numerics.arrays import COMPONENTS, SMALLEST, Array, Mask, Places, median
from multipos.positions.headers import component
from multipos.positions.open_rolls import OpenRolls, across, gather_open_rolls
from multipos.positions.order import Order, check_order
from multipos.positions.readings import Readings
from multipos.positions.scheme import Scheme, of_size, read_scheme
from multipos.results import frozen

_DIGITS = 9  # of a direction that comes again
_FIRST_SD = np.radians(0.1)  # where the estimate of an orientation sd starts
_ONE_G = 0.01  # within which a known force may pass for gravity
_ANY = (1.0, 0.0, 0.0)  # a direction, where none is known
_LOG_ROWS, _LOG_STEP = 100, 0.1  # rows, and their usual step over the spread of all
_CONTRARY = 5.0  # [degrees], by which directions of a row contradict each other
_EXACT = 2.0**-52  # [rad], rounding of a unit vector: nearer than that no position is known


@frozen
class StatedOrientations:
    """What is known of the positions.

    Attributes
    ----------
    reference : (n, 3) array [g]
        Listed ±g u; anything where `orientation_sd` is infinite.
    orientation_sd : (n,) array [rad]
        Standard deviation per axis; 0 exact, inf unknown.
    group : (n,) array of int
        Number of the group that shares an unknown rotation, −1 for none.
    attitude : (n, 3, 3) array or None
        Level to case, where `level_sd` is above 0.
    level_sd : float [rad]
        Standard deviation of a tilt that all positions share.
    estimated : bool
        `orientation_sd` is relative; its size is to be estimated.
    rolls : OpenRolls or None
        Positions whose angle about an axis is open; `orientation_sd` is across their circle.
    label : (n,) array of int or None
        Number of the label of each position, or of its direction where none has one.
    """

    reference: Array
    orientation_sd: Array
    group: Places
    attitude: Array | None = None
    level_sd: float = 0.0
    estimated: bool = False
    rolls: OpenRolls | None = None
    label: Places | None = None

    @property
    def exact(self) -> bool:
        """Whether every position is known exactly, so that the fit is linear."""
        fixed = not self.groups and not self.level_sd and self.rolls is None
        return fixed and not self.orientation_sd.any()

    @property
    def unknown(self) -> bool:
        """Whether nothing is known of any position."""
        return bool(np.isinf(self.orientation_sd).all())

    @property
    def groups(self) -> int:
        """Number of groups."""
        return int(self.group.max()) + 1

    @property
    def repeats(self) -> bool:
        """Whether rows share a label."""
        return self.label is not None and int(self.label.max()) + 1 < len(self.label)

    @property
    def listed(self) -> Mask:
        """Positions whose direction is listed in the world's axes, (n,)."""
        return listed_rows(self.orientation_sd, self.group, self.rolls)


def listed_rows(orientation_sd: Array, group: Places, rolls: OpenRolls | None) -> Mask:
    """Return the positions (n,) whose direction is listed in the world's axes."""
    listed = np.isfinite(orientation_sd) & (group < 0)
    return listed if rolls is None else listed & ~rolls.rows


def place(
    readings: Readings,
    size: float,
    *,
    orientation_sd: float | None = None,
    estimate: bool = False,
    level_sd: float = 0.0,
) -> StatedOrientations:
    """Return what oriented readings and options say of the positions.

    Parameters
    ----------
    readings : Readings
        With up vectors; NaN where nothing is known of a position.
    size : float [g]
        Magnitude of the reference, negative under the gravity convention.
    orientation_sd : float [rad], optional
        Instead of the readings' own. Below the rounding of a unit vector it counts as exact.
    estimate : bool
        The size of the orientation sd is to be estimated.
    level_sd : float [rad]

    Raises
    ------
    MultiposError
        A position has no orientation and none is said to be unknown, or lacks a heading.
    """
    labels = readings.group or ("",) * len(readings)
    sd = _sd_of(readings, labels, orientation_sd)
    level = 0.0 if level_sd < _EXACT else level_sd
    unknown = np.isinf(sd)
    rolls = gather_open_rolls(readings, labels, unknown)
    group = _group_numbers(labels, rolls)
    if estimate and not sd[~unknown].any():
        sd = np.where(unknown, sd, _FIRST_SD)
    reference = _references(readings, unknown, rolls, size)
    return StatedOrientations(
        reference=reference,
        orientation_sd=sd,
        group=group,
        attitude=_attitude(readings, unknown) if level else None,
        level_sd=level,
        estimated=estimate,
        rolls=rolls,
        label=_label_numbers(readings, reference),
    )


def _label_numbers(readings: Readings, reference: Array) -> Places:
    """Return the number of the label of each position (n,), or of its direction without labels."""
    if readings.positions is not None:
        labels: Sequence[object] = readings.positions
    else:
        labels = [tuple(each) for each in (np.round(reference, _DIGITS) + 0.0).tolist()]
    number = {label: i for i, label in enumerate(dict.fromkeys(labels))}
    return np.array([number[label] for label in labels])


def _group_numbers(labels: Sequence[str], rolls: OpenRolls | None) -> Places:
    """Return the number of the group whose rotation a position shares (n,), −1 for none."""
    if rolls is not None:  # whose groups share an inclination
        pairs = zip(labels, rolls.rows.tolist(), strict=True)
        labels = ["" if rolled else label for label, rolled in pairs]
    number = {label: i for i, label in enumerate(dict.fromkeys(filter(None, labels)))}
    if not number:
        return np.full(len(labels), -1)
    return np.array([number.get(label, -1) for label in labels])


def _references(readings: Readings, unknown: Mask, rolls: OpenRolls | None, size: float) -> Array:
    """Return the references (n, 3) [g]: known forces as they stand, the others of a size."""
    up = _directions(readings, unknown, rolls)
    reference = up if size == 1.0 else size * up + 0.0
    if readings.force is None:
        return reference
    # Of a force in a direction that is unknown the size is left.
    length = np.linalg.norm(readings.force, axis=1)[:, None] * _ANY
    known = np.where(unknown[:, None], length, readings.force)
    return np.where(readings.forced[:, None], np.sign(size) * known, reference) + 0.0


def _directions(readings: Readings, unknown: Mask, rolls: OpenRolls | None) -> Array:
    """Return up vectors (n, 3), any where a direction is unknown, any of its circle for a roll."""
    if unknown.all():
        return np.tile(_ANY, (len(readings), 1))
    up = np.full((len(readings), 3), np.nan) if readings.up is None else readings.up
    if rolls is not None:
        up = np.where(rolls.rows[:, None], across(rolls.vectors), up) + 0.0
    missing = np.isnan(up).any(axis=1) & ~unknown & ~readings.forced
    if missing.any():
        raise MultiposError(
            f"position '{readings.labels[int(np.argmax(missing))]}' has no orientation; give it, "
            "or leave its orientation_sd_deg empty for unknown."
        )
    return np.where(unknown[:, None], _ANY, up) if unknown.any() else up


def _sd_of(readings: Readings, labels: Sequence[str], stated: float | None) -> Array:
    """Return the standard deviation of every position [rad], what rounds to nothing as exact."""
    if stated is not None:
        sd = np.full(len(readings), stated)
    elif readings.orientation_sd is None:
        sd = np.zeros(len(readings))
    else:  # within a group only the group's rotation is unknown
        sd = readings.orientation_sd
        if readings.group is not None:
            grouped = np.array([label != "" for label in labels])
            sd = np.where(np.isinf(sd) & grouped, 0.0, sd)
    return np.where(sd < _EXACT, 0.0, sd)


def orient(
    readings: Readings,
    scheme: "Source | Scheme | None",
    order: Order = "paper",
    *,
    estimable: bool = False,
) -> Readings:
    """Return readings with the orientation of a scheme, matched by label or row by row.

    Where the caller can estimate orientations, the error says how.

    Raises
    ------
    MultiposError
        Neither the readings nor a scheme say the orientation, or labels and counts do not match.
    """
    check_order(order)
    oriented = readings.up is not None or readings.rotation is not None
    if scheme is None:
        if oriented:
            return _with_up(readings)
        _refuse_log(readings)
        _refuse_faces(readings, order)
        raise MultiposError(
            f"{readings.source or 'the readings'}: no orientation{_meant(readings)}; give "
            f"--scheme (a name or a file){_columns_for(readings, estimable)}."
        )
    given = read_scheme(scheme, order=order)
    rows = _match(readings, given)
    if oriented:
        _refuse_contradiction(readings, given, rows)
    positions = readings.positions
    if positions is None and given.labels is not None:
        positions = tuple(given.labels[row] for row in rows)
    return replace(
        readings,
        up=given.up[rows],
        rotation=given.rotation[rows],
        force=None if given.force is None else given.force[rows],
        open_roll=None,
        positions=positions,
    )


_SIX = ("faces-6", "song-qin-6")


def _refuse_faces(readings: Readings, order: Order) -> None:
    """Refuse six readings that look like the six faces, with the line to type for them."""
    values = readings.values
    if values.shape != (6, 3) or readings.source is None:
        return
    middle = 0.5 * (values.max(axis=0) + values.min(axis=0))
    off = values - middle
    axis = np.abs(off / np.ptp(values, axis=0).clip(min=SMALLEST)).argmax(axis=1)
    up = np.zeros((6, 3))
    up[np.arange(6), axis] = np.sign(off[np.arange(6), axis])
    if len({*map(tuple, up.tolist())}) < 6:
        return
    same = [name for name in _SIX if (read_scheme(name, order=order).up == up).all()]
    faces = [f"{'-' if each.min() < 0 else '+'}{'XYZ'[int(np.abs(each).argmax())]}" for each in up]
    name = Path(readings.source).name
    way = (
        f"type multipos fit {name} --scheme {same[0]}"
        if same
        else f"write them into a column face and type multipos fit {name}"
    )
    raise MultiposError(
        f"{readings.source}: no orientation; the rows look like the faces {', '.join(faces)}: {way}"
        " (or in the other convention, where the axis that points down reads +1)."
    )


def _refuse_contradiction(readings: Readings, scheme: Scheme, rows: Sequence[int]) -> None:
    """Refuse readings whose own directions differ from those of the scheme."""
    own = _with_up(readings).up
    assert own is not None
    off = np.degrees(np.arccos(np.clip((own * scheme.up[rows]).sum(axis=1), -1.0, 1.0)))
    contrary = np.flatnonzero(off > _CONTRARY)  # a row without direction is NaN
    if len(contrary):
        row = int(contrary[0])
        there = scheme.labels[rows[row]] if scheme.labels else str(rows[row] + 1)
        raise MultiposError(
            f"{readings.source or 'the readings'}: row {row + 1}, '{readings.labels[row]}', points "
            f"{_shown(own[row])} by its own column and {_shown(scheme.up[rows[row]])} as position "
            f"'{there}' of scheme '{scheme.name}' ({len(contrary)} of {len(rows)} rows differ); "
            "leave --scheme away, or the column."
        )


def _shown(up: Array) -> str:
    return f"({', '.join(f'{each:.3g}' for each in (np.round(up, 3) + 0.0).tolist())})"


def _columns_for(readings: Readings, estimable: bool) -> str:
    """Return which columns state orientations, and the option that estimates them."""
    if all(component(name).magnetic for name in readings.outputs):
        return " or the direction of the field as b_x, b_y, b_z"
    columns = "columns such as direction or up_x, up_y, up_z"
    if estimable and len(readings.outputs) >= len(COMPONENTS):
        return f", {columns}, or --unknown-orientation"
    return f" or {columns}, or known forces f_x, f_y, f_z"


def _meant(readings: Readings) -> str:
    """Return what a column of text that is not used was meant to be called, in words."""
    unused = [each.text for each in readings.findings if each.code == "unused-column"]
    for name in (first for text in unused for first in text.split("'")[1:2]):
        way = near(name, ("direction",)).rstrip(".?")
        if way:
            return f", and a column '{name}'{way}"
    return ""


def as_used(readings: Readings, orientation_sd: Array) -> Readings:
    """Return readings that say of their positions what was used of them (n,) [rad]."""
    said = readings.orientation_sd
    same = not orientation_sd.any() if said is None else np.array_equal(said, orientation_sd)
    return readings if same else replace(readings, orientation_sd=orientation_sd)


def without_orientation(readings: Readings, scheme: object) -> Readings:
    """Return readings of which no orientation is used, saying what is ignored."""
    findings = readings.findings
    _require_one_size(readings)
    if readings.up is None and readings.rotation is None:
        _refuse_log(readings)
    given = (readings.up, readings.rotation, readings.orientation_sd, readings.group)
    if any(columns is not None for columns in given):
        text = "orientation columns are ignored; orientations are estimated"
        action = "Remove the columns, or --unknown-orientation."
        findings += (Finding("orientation-ignored", "warning", text, action),)
    if scheme is not None:
        text = "--scheme is ignored; orientations are estimated"
        action = "Remove --scheme, or --unknown-orientation."
        findings += (Finding("orientation-ignored", "warning", text, action),)
    return replace(
        readings,
        up=None,
        rotation=None,
        force=None,
        orientation_sd=np.full(len(readings), np.inf),
        group=None,
        open_roll=None,
        findings=findings,
    )


def are_samples(readings: Readings) -> bool:
    """Tell whether rows are samples of a raw log: no labels, each where the one before stood."""
    if readings.positions is not None or len(readings) < _LOG_ROWS:
        return False
    values = readings.values
    step = median(np.linalg.norm(np.diff(values, axis=0), axis=1))
    return bool(step < _LOG_STEP * np.linalg.norm(values.std(axis=0)))


def _refuse_log(readings: Readings) -> None:
    """Refuse a file of samples; who hands in arrays may take each as a position."""
    if readings.source is not None and are_samples(readings):
        name = Path(readings.source).name
        raise MultiposError(
            f"{readings.source}: {len(readings)} rows of samples, not of "
            f"means; calibrate the log with multipos calibrate {name}, or average its rests "
            f"first with multipos average {name} -o readings.csv."
        )


def _require_one_size(readings: Readings) -> None:
    """Refuse forces of different sizes where only one size of all could be used."""
    if readings.force is None or not readings.forced.any():
        return
    size = np.linalg.norm(readings.force[readings.forced], axis=1)
    if np.abs(size - 1.0).max() > _ONE_G:
        raise MultiposError(
            f"{readings.source or 'the readings'}: the known forces are of {size.min():.3g} to "
            f"{size.max():.3g} g, but --unknown-orientation takes all as one g; leave that option "
            "out, or give these rows an empty orientation_sd_deg, which keeps their size."
        )


def _attitude(readings: Readings, unknown: Mask) -> Array:
    n = len(readings)
    rotation = np.full((n, 3, 3), np.nan) if readings.rotation is None else readings.rotation
    open_heading = np.isnan(rotation).any(axis=(1, 2)) & ~unknown
    if open_heading.any():
        names = [readings.labels[row] for row in np.flatnonzero(open_heading)[:6].tolist()]
        raise MultiposError(
            f"--level-sd needs the heading, and position {', '.join(map(repr, names))} has none; "
            "give direction, roll_deg pitch_deg yaw_deg, a quaternion, or roll_axis angle_deg."
        )
    return np.where(unknown[:, None, None], np.eye(3), rotation)


def _with_up(readings: Readings) -> Readings:
    if readings.up is not None:
        return readings
    assert readings.rotation is not None
    return replace(readings, up=readings.rotation[:, :, 2])


def _match(readings: Readings, scheme: Scheme) -> list[int]:
    """Return the row of the scheme of every reading: by label, or row by row."""
    labels, known = readings.positions, scheme.labels
    oriented = readings.up is not None or readings.rotation is not None
    if oriented and len(readings) == len(scheme) and set(labels or ()).isdisjoint(known or ()):
        return list(range(len(scheme)))
    if labels is not None and known is not None:
        return _match_labels(readings, labels, scheme, known)
    if len(readings) == len(scheme):
        return list(range(len(scheme)))
    _refuse_log(readings)
    unlabelled = "neither" if labels is None and known is None else "only one"
    count = Counter(labels or known or ())
    seen = f"; the labels are {quoted(count)}" if count else ""
    raise MultiposError(
        f"{readings.source or 'the readings'}: {len(readings)} readings but scheme "
        f"'{scheme.name}' has {len(scheme)} positions and {unlabelled} has labels{seen}; "
        "add a 'position' column to both."
    )


def _match_labels(
    readings: Readings, labels: tuple[str, ...], scheme: Scheme, known: tuple[str, ...]
) -> list[int]:
    index = {label: row for row, label in enumerate(known)}
    strange = sorted({label for label in labels if label not in index}, key=labels.index)
    if strange:
        raise MultiposError(
            f"{readings.source or 'the readings'}: position {quoted(strange)} is not in "
            f"scheme '{scheme.name}', whose labels are {quoted(known)}; use its labels, "
            f"or a scheme of {len(set(labels))} positions: {of_size(len(set(labels)))}."
        )
    return [index[label] for label in labels]
