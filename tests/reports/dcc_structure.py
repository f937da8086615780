"""What schema 3.3.0 of the digital calibration certificate allows, as far as a report uses it.

For every element its children in order, each with how often it may stand: '' once, '?' at most
once, '+' once or more, '*' any number. The schema itself is not ours to ship.
"""

import re
from collections.abc import Iterator
from xml.etree import ElementTree

TEXT, RICH = "content+", "content*"
CONTACT = "name location"
ORDER = {
    "digitalCalibrationCertificate": "administrativeData measurementResults document?",
    "administrativeData": (
        "dccSoftware coreData items calibrationLaboratory respPersons customer statements?"
    ),
    "dccSoftware": "software+",
    "software": "name release",
    "coreData": (
        "countryCodeISO3166_1 usedLangCodeISO639_1+ mandatoryLangCodeISO639_1+ uniqueIdentifier "
        "receiptDate? beginPerformanceDate endPerformanceDate performanceLocation issueDate?"
    ),
    "items": "item+",
    "item": "name manufacturer? model? identifications",
    "manufacturer": "name",
    "identifications": "identification+",
    "identification": "issuer value name?",
    "calibrationLaboratory": "calibrationLaboratoryCode? contact cryptElectronicSignature?",
    "contact": CONTACT,
    "customer": CONTACT,
    "location": "countryCode? further*",
    "respPersons": "respPerson+",
    "respPerson": "person mainSigner? cryptElectronicSignature?",
    "person": "name",
    "statements": "statement+",
    "statement": "declaration?",
    "measurementResults": "measurementResult+",
    "measurementResult": "name usedMethods? influenceConditions? results",
    "usedMethods": "usedMethod+",
    "usedMethod": "name description? reference*",
    "influenceConditions": "influenceCondition+",
    "influenceCondition": "name data",
    "results": "result+",
    "result": "name data",
    "list": "quantity+",
    "quantity": "name? description? (real|realListXMLList)",
    "byteData": "fileName mimeType dataBase64",
    "document": "fileName mimeType dataBase64",
    "real": "value unit measurementUncertaintyUnivariate?",
    "measurementUncertaintyUnivariate": "expandedMU",
    "expandedMU": "valueExpandedMU coverageFactor coverageProbability distribution?",
    "realListXMLList": "valueXMLList unitXMLList",
    "data": "(quantity|list|byteData)+",
    "name": TEXT,
    "description": RICH,
    "declaration": RICH,
    "further": RICH,
}
DECIMAL = r"[-+]?\d+(\.\d+)?([eE][-+]?\d+)?"
PATTERN = {
    "countryCodeISO3166_1": "[A-Z]{2}",
    "countryCode": "[A-Z]{2}",
    "usedLangCodeISO639_1": "[a-z]{2}",
    "mandatoryLangCodeISO639_1": "[a-z]{2}",
    "uniqueIdentifier": r"\S+(\s+\S+)*",
    "release": r"\S+(\s+\S+)*",
    "beginPerformanceDate": r"\d{4}-\d\d-\d\d",
    "endPerformanceDate": r"\d{4}-\d\d-\d\d",
    "issueDate": r"\d{4}-\d\d-\d\d",
    "performanceLocation": "laboratory|customer|laboratoryBranch|customerBranch|other",
    "issuer": "manufacturer|calibrationLaboratory|customer|owner|other",
    "cryptElectronicSignature": "true|false",
    "mainSigner": "true|false",
    "value": r"\S.*",
    "valueExpandedMU": DECIMAL,
    "coverageFactor": r"[1-9]\d*(\.\d+)?",
    "coverageProbability": r"0?\.\d+",
    "unit": r"(\\[a-z]+(\\tothe\{-?\d+\})?)+",
    "valueXMLList": rf"{DECIMAL}( {DECIMAL})*",
    "dataBase64": r"[A-Za-z0-9+/]+=*",
}


def faults(element: ElementTree.Element) -> Iterator[str]:
    """Yield what an element and all below it have that the schema does not allow."""
    name = element.tag.partition("}")[2]
    children = [child.tag.partition("}")[2] for child in element]
    if name in ORDER:
        parts = [re.fullmatch(r"\(?([\w|]+)\)?([?+*]?)", part) for part in ORDER[name].split()]
        pattern = "".join(f"(?:(?:{part[1]}) ){part[2]}" for part in parts)
        if not re.fullmatch(pattern, "".join(f"{child} " for child in children)):
            yield f"{name} has {children}, not {ORDER[name]}"
    elif children:
        yield f"{name} has {children}"
    if name in PATTERN and not re.fullmatch(PATTERN[name], element.text or ""):
        yield f"{name} is '{(element.text or '')[:60]}'"
    for child in element:
        yield from faults(child)
