r"""The result as a digital calibration certificate: DCC 3.3 with values in D-SI.

The certificate of the Physikalisch-Technische Bundesanstalt has four parts: who, what and when;
the results; a comment; and the page for people, here the HTML report. Every parameter is a quantity
with its expanded uncertainty U, coverage factor k and coverage probability; beside them stand their
covariance and the whole calibration as JSON. Units are those of D-SI, in which there is no g: where
the local gravity is known, a coefficient of degree d is divided by 9.80665^d and stated per
(m/s²)^d; where it is not, forces are ratios to the local gravity, of the unit ``\one``. What has no
SI unit, such as a count, is ``\one`` with its name beside it.

The file is not signed, and says so.

References
----------
DCC schema 3.3.0, https://ptb.de/dcc/v3.3.0/; D-SI, https://ptb.de/si.
"""

import base64
import datetime
import re
from collections.abc import Iterable, Mapping, Sequence
from xml.etree import ElementTree

import numpy as np

from multipos.errors import MultiposError
from multipos.files.spelling import one_line, packaged_pairs
from multipos.files.trees import to_json
from multipos.reports.certificate import Content
from multipos.sensor.calibration import Calibration
from multipos.units import STANDARD_GRAVITY

DCC, SI = "https://ptb.de/dcc", "https://ptb.de/si"
VERSION = "3.3.0"
_NO_CHARACTERS = re.compile("[\ufffe\uffff]")  # of XML
_SCHEMA = "http://www.w3.org/2001/XMLSchema-instance"
# What the schema needs and only the laboratory knows.
NEEDED = (
    "report.number",
    "report.authorised_by",
    "laboratory.name",
    "laboratory.address",
    "laboratory.country",
    "customer.name",
    "customer.address",
    "item.description",
    "item.serial",
    "measurement.performed",
)
_PLACES = ("laboratory", "customer", "laboratoryBranch", "customerBranch", "other")
_UNITS = packaged_pairs(__file__, "si_units.csv")

Lab = Mapping[str, str]


def dcc_report(calibration: Calibration, content: Content, page: str) -> str:
    """Return the certificate as XML, of accelerometers.

    Parameters
    ----------
    calibration : Calibration
    content : Content
        Of the report, whose statements, findings and words of the laboratory are taken over.
    page : str
        The HTML report, which goes inside.

    Raises
    ------
    MultiposError
        The laboratory has not said what the schema needs, the fields named as `section.key`, or
        the coverage factor is below one.
    """
    field = calibration.field
    if field.unit != "g":  # D-SI has no other unit of a reference that is written here
        raise MultiposError(
            "the certificate as XML is written of accelerometers; report a "
            f"{field.sensor.lower()} as .html, .pdf, .md or .txt."
        )
    lab = content.lab
    _require(lab)
    _require_coverage(calibration)
    for prefix, namespace in (("dcc", DCC), ("si", SI), ("xsi", _SCHEMA)):
        ElementTree.register_namespace(prefix, namespace)
    writer = _Writer()
    root = ElementTree.Element(f"{{{DCC}}}digitalCalibrationCertificate")
    root.set(f"{{{_SCHEMA}}}schemaLocation", f"{DCC} {DCC}/v{VERSION}/dcc.xsd")
    root.set("schemaVersion", VERSION)
    _administrative(writer, root, calibration, content, lab)
    _results(writer, root, calibration, lab)
    document = writer.add(root, "document")
    writer.file(document, "report.html", "text/html", page)
    ElementTree.indent(root)
    text = ElementTree.tostring(root, encoding="unicode", short_empty_elements=False)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{text}\n'


def _require(lab: Lab) -> None:
    missing = [field for field in NEEDED if not lab.get(field, "").strip()]
    if missing:
        raise MultiposError(
            f"a digital calibration certificate needs {', '.join(missing)} of the laboratory; "
            "write them into a TOML file, such as `number` under [report], and give it by --lab."
        )
    if not re.fullmatch("[A-Z]{2}", lab["laboratory.country"]):
        raise MultiposError(
            f"laboratory.country is '{lab['laboratory.country']}'; give the two capital letters "
            "of ISO 3166-1, such as DE."
        )


def _require_coverage(c: Calibration) -> None:
    least = float(np.nanmin(c.k, initial=np.inf))
    if least < 1.0:
        raise MultiposError(
            f"at a confidence of {c.confidence:g} the coverage factor is {least:.3g}, and a "
            "digital calibration certificate takes 1 or more; fit with --confidence 0.95."
        )


class _Writer:
    """Adds elements to a tree; texts in English."""

    def add(self, parent: ElementTree.Element, name: str, text: str = "") -> ElementTree.Element:
        """Add an element of the certificate, ``si:`` before a name of D-SI."""
        space = SI if name.startswith("si:") else DCC
        child = ElementTree.SubElement(parent, f"{{{space}}}{name.removeprefix('si:')}")
        child.text = _NO_CHARACTERS.sub("\ufffd", one_line(text)) or None
        return child

    def words(self, parent: ElementTree.Element, name: str, text: str) -> ElementTree.Element:
        """Add an element that holds a text."""
        child = self.add(parent, name)
        self.add(child, "content", text).set("lang", "en")
        return child

    def file(self, parent: ElementTree.Element, name: str, kind: str, text: str) -> None:
        """Add a file inside."""
        self.add(parent, "fileName", name)
        self.add(parent, "mimeType", kind)
        self.add(parent, "dataBase64", base64.b64encode(text.encode("utf-8")).decode("ascii"))

    def data_of(self, parent: ElementTree.Element, name: str, text: str) -> ElementTree.Element:
        """Add a named element and return where its data go."""
        child = self.add(parent, name)
        self.words(child, "name", text)
        return self.add(child, "data")

    def quantity(
        self, parent: ElementTree.Element, name: str, value: float, unit: str, label: str = ""
    ) -> ElementTree.Element:
        """Add a quantity and return its real number, to which an uncertainty may be added."""
        quantity = self.add(parent, "quantity")
        self.words(quantity, "name", name)
        if label:
            self.words(quantity, "description", label)
        real = self.add(quantity, "si:real")
        self.add(real, "si:value", _number(value))
        self.add(real, "si:unit", unit)
        return real


def _administrative(
    writer: _Writer,
    root: ElementTree.Element,
    calibration: Calibration,
    content: Content,
    lab: Lab,
) -> None:
    part = writer.add(root, "administrativeData")
    software = writer.add(writer.add(part, "dccSoftware"), "software")
    writer.words(software, "name", "multipos")
    writer.add(software, "release", calibration.version)
    _core_data(writer, part, lab)
    item = writer.add(writer.add(part, "items"), "item")
    writer.words(item, "name", lab["item.description"])
    if lab.get("item.manufacturer"):
        writer.words(writer.add(item, "manufacturer"), "name", lab["item.manufacturer"])
    if lab.get("item.type"):
        writer.add(item, "model", lab["item.type"])
    serial = writer.add(writer.add(item, "identifications"), "identification")
    writer.add(serial, "issuer", "manufacturer")
    writer.add(serial, "value", lab["item.serial"])
    writer.words(serial, "name", "Serial number")
    laboratory = writer.add(part, "calibrationLaboratory")
    if lab.get("laboratory.accreditation"):
        writer.add(laboratory, "calibrationLaboratoryCode", lab["laboratory.accreditation"])
    contact = writer.add(laboratory, "contact")
    writer.words(contact, "name", lab["laboratory.name"])
    location = writer.add(contact, "location")
    writer.add(location, "countryCode", lab["laboratory.country"])
    writer.words(location, "further", lab["laboratory.address"])
    writer.add(laboratory, "cryptElectronicSignature", "false")
    person = writer.add(writer.add(part, "respPersons"), "respPerson")
    writer.words(writer.add(person, "person"), "name", lab["report.authorised_by"])
    writer.add(person, "mainSigner", "true")
    writer.add(person, "cryptElectronicSignature", "false")
    customer = writer.add(part, "customer")
    writer.words(customer, "name", lab["customer.name"])
    writer.words(writer.add(customer, "location"), "further", lab["customer.address"])
    _statements(writer, part, content, lab)


def _core_data(writer: _Writer, part: ElementTree.Element, lab: Lab) -> None:
    core = writer.add(part, "coreData")
    writer.add(core, "countryCodeISO3166_1", lab["laboratory.country"])
    writer.add(core, "usedLangCodeISO639_1", "en")
    writer.add(core, "mandatoryLangCodeISO639_1", "en")
    writer.add(core, "uniqueIdentifier", lab["report.number"])
    if lab.get("item.received"):
        writer.add(core, "receiptDate", _dates(lab, "item.received")[0])
    performed = _dates(lab, "measurement.performed")
    writer.add(core, "beginPerformanceDate", performed[0])
    writer.add(core, "endPerformanceDate", performed[-1])
    place = lab.get("laboratory.location", "")
    writer.add(core, "performanceLocation", place if place in _PLACES else "laboratory")
    if lab.get("report.issued"):
        writer.add(core, "issueDate", _dates(lab, "report.issued")[0])


def _dates(lab: Lab, field: str) -> list[str]:
    """Return the dates of a field, one or two, as ISO 8601 has them."""
    found = re.findall(r"\d{4}-\d{2}-\d{2}", lab[field])
    try:
        dates = [datetime.date.fromisoformat(text) for text in found]
    except ValueError:
        dates = []
    if not 1 <= len(dates) <= 2 or dates != sorted(dates):
        raise MultiposError(
            f"{field} is '{lab[field]}'; a digital calibration certificate needs a date such as "
            "2026-03-01, or the first and the last as 2026-03-01/2026-03-02."
        )
    return [date.isoformat() for date in dates]


def _statements(writer: _Writer, part: ElementTree.Element, content: Content, lab: Lab) -> None:
    said = [
        "This file is not signed; it holds as far as its source vouches for it.",
        content.sentence,
        *content.findings,
        *(
            f"{words}: {lab[field]}"
            for field, words in (
                ("laboratory.location", "Place of calibration"),
                ("item.condition", "Condition of the item"),
                ("measurement.conditions", "Environmental conditions"),
                ("measurement.traceability", "Metrological traceability"),
                ("measurement.deviations", "Deviations from the method"),
                ("measurement.remarks", "Remarks"),
            )
            if lab.get(field)
        ),
    ]
    statements = writer.add(part, "statements")
    for text in said:
        writer.words(writer.add(statements, "statement"), "declaration", text)


def _results(writer: _Writer, root: ElementTree.Element, c: Calibration, lab: Lab) -> None:
    results = writer.add(root, "measurementResults")
    result = writer.add(results, "measurementResult")
    writer.words(result, "name", "Static calibration in gravity")
    method = writer.add(writer.add(result, "usedMethods"), "usedMethod")
    if lab.get("measurement.method"):
        writer.words(method, "name", lab["measurement.method"])
    else:
        writer.words(method, "name", "static positions in gravity")
    writer.words(method, "description", _description(c))
    writer.add(method, "reference", "JCGM 100:2008")
    _conditions(writer, result, c)
    found = writer.add(result, "results")
    _parameters(writer, found, c)
    _covariance(writer, found, c)
    whole = writer.data_of(found, "result", "The calibration as JSON")
    data = writer.add(whole, "byteData")
    writer.file(data, "calibration.json", "application/json", to_json(c.to_dict()))


def _description(c: Calibration) -> str:
    gravity = "forces are ratios to the local gravity, which is not stated"
    if c.gravity is not None:
        gravity = f"gravity {c.gravity.value:.10g} m/s^2, u = {c.gravity.u:.3g} m/s^2"
    return (
        f"model {c.model.text}; estimator {c.estimator}; convention {c.convention}; "
        f"{len(c.readings)} readings of {', '.join(c.outputs)}; {gravity}"
    )


def _conditions(writer: _Writer, result: ElementTree.Element, c: Calibration) -> None:
    temperature = c.readings.environment.get("temperature")
    if temperature is None or not np.isfinite(temperature).all():
        return
    conditions = writer.add(result, "influenceConditions")
    said = "temperature during the calibration, mean"
    data = writer.data_of(conditions, "influenceCondition", said)
    writer.quantity(data, "temperature", float(temperature.mean()), r"\degreecelsius")


def _parameters(writer: _Writer, found: ElementTree.Element, c: Calibration) -> None:
    table = writer.add(writer.data_of(found, "result", "Parameters"), "list")
    for parameter in c.entries:
        factor, unit, named = _unit(parameter.unit, known=c.gravity is not None)
        label = f"{parameter.label}, unit {parameter.unit}" if named else parameter.label
        value, U = parameter.value * factor, parameter.U * factor
        real = writer.quantity(table, parameter.name, value, unit, label)
        if not np.isfinite(U):
            continue
        univariate = writer.add(real, "si:measurementUncertaintyUnivariate")
        expanded = writer.add(univariate, "si:expandedMU")
        writer.add(expanded, "si:valueExpandedMU", _number(U))
        writer.add(expanded, "si:coverageFactor", _number(parameter.k))
        writer.add(expanded, "si:coverageProbability", _number(c.confidence))
        normal = np.isinf(parameter.dof)
        writer.add(expanded, "si:distribution", "normal" if normal else "t")


def _covariance(writer: _Writer, found: ElementTree.Element, c: Calibration) -> None:
    """Add the covariance of the parameters, a quantity a row, in the units of their products."""
    names = [parameter.name for parameter in c.entries]
    units = [_unit(parameter.unit, known=c.gravity is not None) for parameter in c.entries]
    factors = np.array([factor for factor, _, _ in units])
    covariance = c.covariance * np.outer(factors, factors)
    said = "Covariance of the parameters, in their order"
    table = writer.add(writer.data_of(found, "result", said), "list")
    for name, row, (_, own, _) in zip(names, covariance, units, strict=True):
        quantity = writer.add(table, "quantity")
        writer.words(quantity, "name", name)
        values = writer.add(quantity, "si:realListXMLList")
        writer.add(values, "si:valueXMLList", " ".join(map(_number, row)))
        products = (_product([own, other]) for _, other, _ in units)
        writer.add(values, "si:unitXMLList", " ".join(products))


def _product(units: Iterable[str]) -> str:
    return "".join(unit for unit in units if unit != r"\one") or r"\one"


def _unit(text: str, *, known: bool) -> tuple[float, str, bool]:
    """Return what a unit of ours is in D-SI: factor, unit, and whether its name must be written."""
    numerator, *divisors = _pieces(text)
    factor, parts, strange = 1.0, [], False
    for piece, sign in ((numerator, 1), *((piece, -1) for piece in divisors)):
        base, _, power = piece.partition("^")
        exponent = sign * (int(power) if power.isdigit() else 1)
        if base == "g":
            factor *= STANDARD_GRAVITY**exponent if known else 1.0
            parts += _powers([(r"\metre", exponent), (r"\second", -2 * exponent)]) if known else []
        elif base == "m/s^2":
            parts += _powers([(r"\metre", exponent), (r"\second", -2 * exponent)])
        elif base in _UNITS:
            parts += _powers([(_UNITS[base], exponent)]) if _UNITS[base] else []
        else:
            strange = True
    return factor, "".join(parts) or r"\one", strange


def _pieces(text: str) -> list[str]:
    """Return numerator and divisors of a unit such as V/g^2/degC; m/s^2 is one."""
    kept = text.replace("m/s^2", "\0")
    return [piece.replace("\0", "m/s^2") for piece in kept.split("/")]


def _powers(bases: Sequence[tuple[str, int]]) -> list[str]:
    return [base if power == 1 else rf"{base}\tothe{{{power}}}" for base, power in bases if power]


def _number(value: float) -> str:
    return repr(float(value))
