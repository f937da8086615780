"""The digital calibration certificate: its structure, its numbers and units, what it refuses."""

import base64
import json
import os
from xml.etree import ElementTree

import numpy as np
import pytest
from numpy.testing import assert_allclose

import multipos as mp
from multipos.reports.dcc import DCC, NEEDED, SI
from tests.reports.dcc_structure import faults

pytestmark = pytest.mark.usefixtures("without_drawing")

LAB = {
    "report": {"number": "K-7 <&>", "authorised_by": "the head", "issued": "2026-03-09"},
    "laboratory": {"name": "Laboratory", "address": "Street 1", "country": "DE"},
    "customer": {"name": "Customer", "address": "Street 2"},
    "item": {"description": "accelerometer", "serial": "17", "type": "A1", "manufacturer": "M"},
    "measurement": {"performed": "2026-03-01/2026-03-02", "traceability": "by the national g"},
}


def calibration(**options):
    rng = np.random.default_rng(4)
    up = mp.read_scheme("faces-corners-14").up
    values = [0.1, -0.2, 2.5] + 1.2 * up + 1e-4 * rng.standard_normal(up.shape)
    readings = mp.Readings(values, up=up, environment={"temperature": np.linspace(20, 22, 14)})
    return mp.fit(readings, **{"unit": "V", "model": "own-quadratic", **options})


def written(tmp_path, cal, **options):
    path = tmp_path / "k.xml"
    mp.report(cal, path, **{"lab": LAB, **options})
    return ElementTree.parse(path).getroot()


def texts(root, path):
    return [found.text for found in root.iterfind(path, {"dcc": DCC, "si": SI})]


def quantities(root):
    """Return the real numbers of the parameters by name, as elements."""
    path = ".//dcc:results/dcc:result[1]/dcc:data/dcc:list/dcc:quantity"
    spaces = {"dcc": DCC, "si": SI}
    return {
        each.find("dcc:name/dcc:content", spaces).text: each.find("si:real", spaces)
        for each in root.iterfind(path, spaces)
    }


@pytest.mark.parametrize(
    "options",
    [
        {"gravity": 9.81, "gravity_u": 1e-5},
        {},
        {"model": "1 + x + y + z + temperature", "unit": "counts"},
        {"unknown_orientation": True, "model": "linear"},
    ],
)
def test_the_structure_is_that_of_the_schema(tmp_path, options):
    root = written(tmp_path, calibration(**options))
    assert list(faults(root)) == []
    schema = os.environ.get("MULTIPOS_DCC_SCHEMA")  # the path of dcc.xsd 3.3.0, where it is at hand
    if schema:
        pytest.importorskip("xmlschema").validate(tmp_path / "k.xml", schema)


def test_numbers_are_those_of_the_calibration_in_units_of_the_si(tmp_path):
    cal = calibration(gravity=9.81, gravity_u=1e-5)
    found = quantities(written(tmp_path, cal))
    assert list(found) == [p.name for p in cal.entries]
    g = 9.80665
    for name, factor, unit in (
        ("bias_ax", 1.0, r"\volt"),
        ("scale_ay", 1.0 / g, r"\volt\metre\tothe{-1}\second\tothe{2}"),
        ("quad_az", 1.0 / g**2, r"\volt\metre\tothe{-2}\second\tothe{4}"),
    ):
        real, parameter = found[name], cal[name]
        assert texts(real, "si:unit") == [unit]
        assert_allclose(float(texts(real, "si:value")[0]), parameter.value * factor, rtol=1e-14)
        part = "si:measurementUncertaintyUnivariate/si:expandedMU/si:"
        assert_allclose(
            float(texts(real, f"{part}valueExpandedMU")[0]), parameter.U * factor, rtol=1e-14
        )
        assert float(texts(real, f"{part}coverageFactor")[0]) == parameter.k
        assert texts(real, f"{part}coverageProbability") == ["0.95"]
        assert texts(real, f"{part}distribution") == ["t"]


def test_covariance_has_the_squares_of_u_on_its_diagonal(tmp_path):
    cal = calibration(gravity=9.81)
    root = written(tmp_path, cal)
    rows = [list(map(float, row.split())) for row in texts(root, ".//si:valueXMLList")]
    reals = quantities(root)
    part = "si:measurementUncertaintyUnivariate/si:expandedMU/si:"
    u = [
        float(texts(real, f"{part}valueExpandedMU")[0]) / cal[name].k
        for name, real in reals.items()
    ]
    assert_allclose(np.sqrt(np.diag(rows)), u, rtol=1e-12)
    assert {len(units.split()) for units in texts(root, ".//si:unitXMLList")} == {len(reals)}


def test_without_gravity_forces_are_ratios_and_a_count_is_named(tmp_path):
    root = written(tmp_path, calibration(unit="counts"))
    real = quantities(root)["scale_ax"]
    assert texts(real, "si:unit") == [r"\one"]
    assert any("unit counts/g" in text for text in texts(root, ".//dcc:description/dcc:content"))
    assert any(
        "ratios to the local gravity" in t for t in texts(root, ".//dcc:usedMethod//dcc:content")
    )
    assert texts(quantities(written(tmp_path, calibration()))["quad_ax"], "si:unit") == [r"\volt"]


def test_the_page_and_the_calibration_are_inside(tmp_path):
    cal = calibration()
    root = written(tmp_path, cal)
    page = base64.b64decode(texts(root, "dcc:document/dcc:dataBase64")[0]).decode()
    assert page.startswith("<!doctype html>") or page.lower().startswith("<!doctype html>")
    inside = json.loads(base64.b64decode(texts(root, ".//dcc:byteData/dcc:dataBase64")[0]))
    assert inside == json.loads(json.dumps(cal.to_dict()))
    said = texts(root, ".//dcc:statement/dcc:declaration/dcc:content")
    assert any("not signed" in text for text in said)
    assert texts(root, ".//dcc:uniqueIdentifier") == ["K-7 <&>"]
    assert texts(root, ".//dcc:endPerformanceDate") == ["2026-03-02"]


def test_missing_fields_are_named(tmp_path):
    with pytest.raises(mp.MultiposError) as error:
        mp.report(calibration(), tmp_path / "k.xml")
    assert all(field in str(error.value) for field in NEEDED)
    assert not (tmp_path / "k.xml").exists()


def test_what_no_xml_holds_is_told_and_blanks_are_not_said(tmp_path):
    given = {"condition": "scratched\x01\ufffe", "type": " ", "manufacturer": "", "received": "\t"}
    lab = {**LAB, "item": {**LAB["item"], **given}}
    root = written(tmp_path, calibration(), lab=lab)
    assert list(faults(root)) == []
    assert "Condition of the item: scratched\\u0001\ufffd" in texts(root, ".//dcc:content")
    assert texts(root, ".//dcc:model") == []
    assert texts(root, ".//dcc:receiptDate") == []


def test_a_coverage_factor_below_one_is_refused(tmp_path):
    """The schema takes 1 or more; k of Student's t at 50 % is .7."""
    with pytest.raises(mp.MultiposError, match="takes 1 or more"):
        mp.report(calibration(confidence=0.5), tmp_path / "k.xml", lab=LAB)
    assert list(faults(written(tmp_path, calibration(confidence=0.7)))) == []


@pytest.mark.parametrize(
    ("section", "key", "value", "message"),
    [
        ("laboratory", "country", "Germany", "two capital letters"),
        ("measurement", "performed", "in March", "measurement.performed is 'in March'"),
        ("measurement", "performed", "2026-03-02/2026-03-01", "the first and the last"),
        ("item", "received", "2026-02-30", "item.received is '2026-02-30'"),
    ],
)
def test_what_the_schema_would_refuse_is_named(tmp_path, section, key, value, message):
    lab = {**LAB, section: {**LAB[section], key: value}}
    with pytest.raises(mp.MultiposError, match=message):
        mp.report(calibration(), tmp_path / "k.xml", lab=lab)
