"""Schemes assessed: what a set of positions tells about a model, and what it hides.

`schemes` assesses named schemes or those given, by an `Assessor` for one setting, which
`read_setting` makes of options and `orientation` names. `schemes_text` prints all,
`positions_table` the positions of one, `scheme_rows` the table, `scheme_details` what stands below
it and `schemes_sentence` the best.

With the information M per position of `multipos.designs.information`, of n positions,

    log_det = ln det M,      u_j = σ sqrt([M⁻¹]_jj / n),                                    (1)

σ the standard uncertainty of a reading. Efficiencies compare M with the best continuous design M*
on the whole sphere (`multipos.designs.optimum`), per position, so that n does not count:

    D   (det M / det M*)^(1/p),        A   tr M*⁻¹ / tr M⁻¹,        I   the same with B,
    G   p / max_u p s(u),        E   λ_min M / λ_min M*, of all outputs together,

and a scheme that needs 1/efficiency times as many positions tells as much. What a scheme cannot
see of the terms that a model lacks is for `multipos.designs.aliases`.

Source: A. C. Atkinson, A. N. Donev, R. D. Tobias, Optimum Experimental Designs, with SAS, 2007
(criteria, efficiencies).
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import zip_longest
from typing import Any

import numpy as np

from multipos.designs.aliases import UNSEEN, find_aliases, in_parameters, say_hidden
from multipos.designs.criteria import least_eigenvalue, make_criterion, objective
from multipos.designs.information import (
    Blocks,
    Setting,
    inform,
    log_det,
    make_setting,
    nothing_to_weigh,
    require_values,
)
from multipos.designs.optimum import ContinuousOptimum, largest_sensitivity, optimise_sphere
from multipos.errors import MultiposError
from multipos.estimation.known import ZERO_NORM
from multipos.files.numbers import number, table
from multipos.files.spelling import Names, StrPath, split_names, spread
from multipos.files.tables import Source
from multipos.finding import Findings
from multipos.numerics.arrays import COMPONENTS, Array
from multipos.numerics.separability import name_combinations, separability
from multipos.numerics.terms import ModelText
from multipos.positions.order import Order
from multipos.positions.scheme import Scheme, lay_scheme, named_schemes
from multipos.results import Keyed, data_frame, frozen
from multipos.sensor.model import Model, build_model, default_axes
from multipos.sensor.model_text import ParsedModel, read_model
from multipos.sensor.own_models import build_parsed

_ORDERS: tuple[Order, ...] = ("spread", "paper")
_LEAST = 1e-6  # singular value, whose square information has few digits for


@frozen
class Assessment(Keyed):
    """What one scheme tells about a model; numbers are None where the model is not identifiable.

    Attributes
    ----------
    name : str
    positions : int
        How many.
    up : mapping of label to (x, y, z)
        Unit vectors pointing up.
    order : tuple of str
        The labels as the positions are laid out.
    drift_absorbed : float
        Share of the variance of the row number that the model absorbs, the largest of the
        outputs, where the positions are measured in this order.
    drift_absorbed_by_order : mapping of 'spread' and 'paper' to float, or None
        The same in both orders, of a scheme that is named alone. Rows without labels are taken in
        order 'paper', as published, by `fit --scheme`.
    identifiable : bool
    unidentifiable : tuple of str
        What the positions cannot separate.
    rank, parameters : int
    dof : mapping of output to int
        Degrees of freedom left for checking the model; 'all' for unknown orientation.
    log_det, d_efficiency, a_efficiency, e_efficiency, g_efficiency, i_efficiency : float or None
    condition : float or None
        Of the rows, their columns at length 1.
    u : mapping of 'output:term' to float, or None
        Standard uncertainty of each parameter, eq. (1).
    aliases : tuple of mappings, or None
        {output, term, seen, into} of each term that the model lacks, by eq. (1) of
        `multipos.designs.aliases`.
    hidden : tuple of str, or None
        Those that the data hide wholly, in words.
    """

    name: str | None
    positions: int
    up: Mapping[str, tuple[float, ...]]
    order: tuple[str, ...]
    drift_absorbed: float
    identifiable: bool
    unidentifiable: tuple[str, ...]
    rank: int
    parameters: int
    dof: Mapping[str, int]
    log_det: float | None = None
    d_efficiency: float | None = None
    a_efficiency: float | None = None
    e_efficiency: float | None = None
    g_efficiency: float | None = None
    i_efficiency: float | None = None
    condition: float | None = None
    u: Mapping[str, float] | None = None
    aliases: tuple[Mapping[str, Any], ...] | None = None
    hidden: tuple[str, ...] | None = None
    drift_absorbed_by_order: Mapping[str, float] | None = None


@frozen
class Schemes(Keyed):
    """What schemes can tell about a model.

    Attributes
    ----------
    model : str
        As a formula or name.
    orientation : str
        'known', 'uncertain' or 'unknown'.
    schemes : tuple of Assessment
    findings : tuple of Finding
    """

    model: str
    orientation: str
    schemes: tuple[Assessment, ...]
    findings: Findings = ()

    def to_pandas(self) -> Any:
        """Return a data frame with a row for each scheme, of what is one number or text each.

        Raises
        ------
        MultiposError
            pandas is not installed.
        """
        return data_frame({name: [entry[name] for entry in self.schemes] for name in _SINGLE})


# What an assessment has one of.
_SINGLE = (
    "name",
    "positions",
    "identifiable",
    "rank",
    "parameters",
    "drift_absorbed",
    "log_det",
    "d_efficiency",
    "a_efficiency",
    "e_efficiency",
    "g_efficiency",
    "i_efficiency",
    "condition",
)


def schemes(
    *sources: "Source | Scheme | Sequence[Source | Scheme]",
    model: ModelText | Model = "linear",
    axes: Names = COMPONENTS,
    inputs: Names = COMPONENTS,
    unknown_orientation: bool = False,
    orientation_sd: float | None = None,
    reading_sd: float = 1.0,
    order: Order | None = None,
) -> Schemes:
    """Return what schemes can tell about a model: all named ones, best first, or those given.

    Parameters
    ----------
    *sources : names, joined names, paths, columns or Scheme
        One by one, or one list or tuple of them.
    model : str or Model
        Name, formula, that of a calibration, or a model of one's own, judged at the parameters
        that it states.
    axes, inputs : names
        As in `multipos.fit`; outputs are named ax, ay, az after their axes.
    unknown_orientation : bool
        Only the norm of f is known, and the parameters are those of the lower gauge.
    orientation_sd : float [degrees], optional
        Standard deviation of the orientation per axis, against `reading_sd` in g.
    reading_sd : float
        Standard uncertainty of a reading, for the predicted u.
    order : str
        'spread', 'travel' or 'paper': how positions are laid out (`multipos.positions.order`);
        'spread' for names where not given, and else as written.

    Returns
    -------
    Schemes

    Examples
    --------
    >>> import multipos as mp
    >>> found = mp.schemes("faces-6", "faces-corners-14", model="own-cubic")
    >>> for entry in found.schemes:
    ...     print(entry.name, entry.identifiable)
    faces-6 False
    faces-corners-14 True
    >>> round(found.schemes[1].d_efficiency, 3)
    0.944
    """
    setting = read_setting(
        model, axes, inputs, unknown_orientation, orientation_sd, reading_sd
    ).stated
    assessor = Assessor(setting)
    given: tuple[Source | Scheme, ...] = spread(sources)
    found = [assessor.describe(lay_scheme(s, order)) for s in given or named_schemes()]
    if len(given) == 1:
        published = lay_scheme(given[0], "paper")
        laid = {name: lay_scheme(published, name).reference for name in _ORDERS}
        shares = {str(name): setting.drift_absorbed(up) for name, up in laid.items()}
        found = [replace(found[0], drift_absorbed_by_order=shares)]
    if not given:
        # of equally good ones, to what rounding leaves, the shortest first
        found.sort(key=lambda e: (-round(e.d_efficiency or 0.0, 9), e.positions))
    return Schemes(
        setting.model.text, orientation(setting), tuple(found), nothing_to_weigh(setting)
    )


def read_setting(
    model: ModelText | Model,
    axes: Names,
    inputs: Names,
    unknown_orientation: bool,
    orientation_sd: float | None,
    reading_sd: float,
) -> Setting:
    """Return the setting of options as `schemes` takes them; outputs are named after their axes."""
    text: StrPath
    if isinstance(model, Model):
        text, axes, inputs = model.text, model.axes, model.inputs
    else:
        text = model
    names = default_axes((), axes)
    seen = split_names(inputs, "--inputs")
    written = read_model(text)
    # a second output on an axis is ax2
    outputs = tuple(
        f"a{axis}" + (str(count) if (count := names[: i + 1].count(axis)) > 1 else "")
        for i, axis in enumerate(names)
    )
    if isinstance(written, ParsedModel):
        used = written.columns_among(())
        written.require_no_near_miss(used, ())
        built: Model = build_parsed(written, outputs, names, seen, "reading", used)
    else:
        built = build_model(written, outputs, names, seen, "reading", known=())
    return make_setting(
        built,
        unknown_orientation=unknown_orientation,
        orientation_sd=orientation_sd,
        reading_sd=reading_sd,
    )


def orientation(setting: Setting) -> str:
    """Return how the orientations of a setting are: known, uncertain or unknown."""
    if setting.orientation_sd == 0.0:
        return "known"
    return "unknown" if math.isinf(setting.orientation_sd) else "uncertain"


class Assessor:
    """Describes schemes for one setting; the optima they are held to are found once."""

    def __init__(self, setting: Setting) -> None:
        self.setting = setting
        self._optima: dict[str, ContinuousOptimum] = {}

    def optimum(self, name: str) -> ContinuousOptimum:
        """Return the best that positions can do on the sphere, by criterion D, A, E or I."""
        if name not in self._optima:
            criterion = make_criterion(name, self.setting)
            try:
                self._optima[name] = optimise_sphere(self.setting, criterion)
            except np.linalg.LinAlgError:
                raise MultiposError(
                    f"the {name}-optimum of these parameters cannot be found, as their sizes are "
                    "too different; state the model in units in which they are of one size."
                ) from None
        return self._optima[name]

    def separate(self, up: Array) -> tuple[list[str], float]:
        """Return what positions cannot separate, in words, and the condition where they can."""
        model, setting = self.setting.model, self.setting
        if not math.isinf(setting.orientation_sd):
            # a finite orientation sd weighs the rows, but takes none away
            setting = Setting(model, parameters=setting.parameters)
        rows = setting.rows(up)[: len(setting.blocks)]
        require_values(setting, rows)
        designs = [
            (model.names[part], Z.reshape(-1, Z.shape[2]))
            for part, Z in zip(setting.blocks, rows, strict=True)
        ]
        found = [
            (names, separability(Z, least_norm=ZERO_NORM, least=_LEAST)) for names, Z in designs
        ]
        problems = [text for names, one in found for text in name_combinations(one.null, names)]
        return problems, max(one.condition for _, one in found)

    def describe(self, scheme: Scheme) -> Assessment:
        """Return what one scheme tells."""
        n, model = len(scheme), self.setting.model
        unidentifiable, condition = self.separate(scheme.reference)
        assessed = Assessment(
            name=scheme.name,
            positions=n,
            up=dict(zip(scheme.names, map(tuple, scheme.reference.tolist()), strict=True)),
            order=scheme.names,
            drift_absorbed=self.setting.drift_absorbed(scheme.reference),
            identifiable=not unidentifiable,
            unidentifiable=tuple(unidentifiable),
            rank=len(model.keys) - len(unidentifiable),
            parameters=len(model.keys),
            dof=_dof(self.setting, n),
        )
        if unidentifiable:
            return assessed
        information = inform(self.setting.rows(scheme.reference))
        inverse = np.concatenate([np.diag(np.linalg.inv(M)) for M in information])
        u = self.setting.reading_sd * np.sqrt(inverse / n)
        found = find_aliases(self.setting, scheme.reference)
        names = [f"{output}:{term}" for output, term in model.keys]
        return replace(
            assessed,
            log_det=log_det(information),
            d_efficiency=self._efficiency(information, "D"),
            a_efficiency=self._efficiency(information, "A"),
            e_efficiency=self._efficiency_of_least(information),
            g_efficiency=min(1.0, 1.0 / largest_sensitivity(self.setting, information)),
            i_efficiency=self._efficiency(information, "I"),
            condition=condition,
            u=dict(zip(names, u.tolist(), strict=True)),
            aliases=tuple(found),
            hidden=tuple(say_hidden(alias) for alias in found if alias["seen"] < UNSEEN),
        )

    def _efficiency(self, information: Blocks, name: str) -> float:
        value = objective(information, make_criterion(name, self.setting))
        # the optimum is known to its gap only
        return min(1.0, math.exp(value - self.optimum(name).value))

    def _efficiency_of_least(self, information: Blocks) -> float | None:
        try:
            best = self.optimum("E")
        except MultiposError:  # of parameters whose units are far apart one alone counts
            return None
        reached = inform(self.setting.rows(best.up), best.weights)
        return min(1.0, least_eigenvalue(information) / least_eigenvalue(reached))


def schemes_text(found: Schemes) -> str:
    """Return `schemes` as text: one table, and of a single scheme its u and what it hides."""
    note = (
        f"orientations {found.orientation}; D, A, E, G and I are efficiencies per position, "
        "against the best on the sphere; drift is what of a linear one the model absorbs"
    )
    parts = [f"model {found.model}", table(*scheme_rows(found.schemes)), note]
    if len(found.schemes) > 1:
        parts.append("largest u of each kind\n" + table(*_by_kind(found.schemes)))
    else:
        (entry,) = found.schemes
        if entry.drift_absorbed_by_order is not None:
            share, published = map("{:.0%}".format, entry.drift_absorbed_by_order.values())
            parts.append(
                f"a linear drift is absorbed to {share} in order spread, {published} as "
                "published; `fit --scheme` takes rows without labels as published"
            )
        parts += [positions_table(entry.up.items()), *scheme_details(entry)]
    return "\n\n".join(parts) + "\n"


def _by_kind(entries: Sequence[Assessment]) -> tuple[list[str], list[list[str]]]:
    """Return header and rows of the largest u of biases, scale factors, cross terms and others."""
    rows = []
    for entry in entries:
        largest: dict[str, float] = {}
        for key, u in (entry.u or {}).items():
            kind = _kind(*key.split(":", 1))
            largest[kind] = max(u, largest.get(kind, 0.0))
        found = (number(largest.get(kind), 3) for kind in _KINDS)
        rows.append([entry.name or "", str(entry.positions), *found])
    return ["scheme", "positions", *_KINDS], rows


def _kind(output: str, term: str) -> str:
    if term == "1":
        return "bias"
    if term not in COMPONENTS:
        return "quad"
    return "scale" if term == output[1] else "cross"


_KINDS = ("bias", "scale", "cross", "quad")
_COLUMN = 24  # positions that stand below each other; of more, several columns


def positions_table(
    positions: Iterable[tuple[str, Sequence[float]]],
    remarks: Sequence[str] = (),
    towards: str = "up",
) -> str:
    """Return positions by label with what points up, many in three columns and several tables."""
    given = list(positions)
    digits = 6 if len(given) <= _COLUMN else 4  # 0.006 degrees
    rows = [
        [label, *(f"{value + 0.0:.{digits}f}" for value in up), *remarks[i : i + 1]]
        for i, (label, up) in enumerate(given)
    ]
    header = ["position", *(f"{towards} {axis}" for axis in COMPONENTS), ""][: len(rows[0])]
    most = 3 * _COLUMN
    pages = (rows[first : first + most] for first in range(0, len(rows), most))
    return "\n\n".join(_in_columns(header, page) for page in pages)


def _in_columns(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table whose rows go on beside each other."""
    deep = -(-len(rows) // -(-len(rows) // _COLUMN))
    parts = [table(header, rows[i : i + deep]).split("\n") for i in range(0, len(rows), deep)]
    widths = [max(map(len, part)) + 4 for part in parts]
    lines = (zip(line, widths, strict=True) for line in zip_longest(*parts, fillvalue=""))
    return "\n".join("".join(cell.ljust(width) for cell, width in line).rstrip() for line in lines)


def scheme_rows(entries: Sequence[Assessment]) -> tuple[list[str], list[list[str]]]:
    """Return header and rows of the table of schemes."""
    header = ["scheme", "positions", "identifiable", *"DAEGI", "log det"]
    header += ["condition (scaled columns)", "drift", "largest u", "dof left"]
    rows = []
    for entry in entries:
        shares = [getattr(entry, f"{each}_efficiency") for each in "daegi"]
        rows.append(
            [
                entry.name or "",
                str(entry.positions),
                "yes" if entry.identifiable else "no",
                *("-" if share is None else f"{share:.3f}" for share in shares),
                number(entry.log_det, 6),
                number(entry.condition, 3),
                f"{100.0 * entry.drift_absorbed:.0f} %",
                number(max(entry.u.values()) if entry.u else None, 3),
                str(min(entry.dof.values())),
            ]
        )
    return header, rows


def scheme_details(entry: Assessment) -> list[str]:
    """Return the parts of a scheme's text below the tables: u, higher terms, what is hidden."""
    if entry.u is None or entry.aliases is None:
        return ["cannot be separated:", *entry.unidentifiable]
    u = [[*key.split(":", 1), number(value)] for key, value in entry.u.items()]
    seen = [
        [
            alias["output"],
            alias["term"],
            "hidden" if alias["seen"] < UNSEEN else f"{alias['seen']:.2f}",
            in_parameters(alias["into"], least=1e-3) or "-",
        ]
        for alias in entry.aliases
    ]
    parts = [table(["output", "term", "u"], u, left=2)]
    if seen:
        lacking = table(["output", "term", "seen", "adds"], seen, left=4)
        parts.append(
            "terms the model lacks: the share that shows in the residuals, and what 1 of it adds\n"
            + lacking
        )
    return parts


def _dof(setting: Setting, count: int) -> dict[str, int]:
    """Return the degrees of freedom left for checking the model."""
    model = setting.model
    if math.isinf(setting.orientation_sd):
        return {"all": count - len(model.keys)}
    return {
        output: count - len(terms) for output, terms in zip(model.outputs, model.terms, strict=True)
    }


def schemes_sentence(found: Schemes) -> str:
    """Return the best of several schemes, and how many cannot determine the model."""
    assessed = [entry for entry in found.schemes if entry.identifiable]
    if not assessed:
        return f"None of {len(found.schemes)} schemes determines the model {found.model}."
    best = max(entry.d_efficiency or 0.0 for entry in assessed)
    tied = [entry for entry in assessed if (entry.d_efficiency or 0.0) > best - 1e-9]
    good = f"{100.0 * best:.1f} % of the best D efficiency per position"
    if len(found.schemes) == 1:
        return f"{tied[0].name}: {tied[0].positions} positions, {good}."
    names = ", ".join(entry.name or "scheme" for entry in tied)
    others = len(found.schemes) - len(assessed)
    without = f"; {others} cannot determine it" if others else ""
    return f"Best of {len(found.schemes)} schemes for {found.model}: {names}, {good}{without}."
