"""What a visitor asks and is answered: the package behind the page, JSON in and JSON out.

The worker calls `Visit.answer` with one request at a time. Files are in the current folder, where
the worker has put what was dropped or pasted, and where it fetches what is downloaded. What is
chosen for the visitor is chosen here: known orientations where the table states them, a raw log
where it has more rows than anybody averages by hand, six faces where six rows lie along both
directions of three axes, and otherwise unknown orientations.
"""

import json
import warnings
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from multipos import __version__
from multipos.compensation.applying import apply
from multipos.designs.designing import design
from multipos.designs.prospects import rank_positions
from multipos.errors import MultiposError, UsageError
from multipos.exports.targets import TargetName, export
from multipos.files.tables import write_table
from multipos.files.whole import first_bytes
from multipos.finding import serious
from multipos.fitting.calibrate_logs import calibrate, in_likely_field, in_likely_unit
from multipos.fitting.fit_readings import fit
from multipos.logs.opening import open_log, read_log
from multipos.numerics.arrays import Array
from multipos.positions.attitudes import pose_words
from multipos.positions.headers import component
from multipos.positions.reading_tables import read_readings
from multipos.positions.readings import Readings
from multipos.reports.documents import report
from multipos.reports.summary import calibration_sentence
from multipos.results import plain
from multipos.sensor.calibration import Calibration, force_residuals
from multipos.sensor.calibration_file import load

TARGETS: tuple[TargetName, ...] = ("px4", "ardupilot")
_SUFFIX = {"c": ".c", "px4": "_px4.params", "ardupilot": "_ardupilot.parm", "md": ".md"}
_MOST_READINGS = 200  # rows: more are a log
_NEXT = 3  # best positions shown
_ALONG = 0.8  # of a reading, the share along its axis: up to 37 degrees from a face
_MOST_BYTES = 300_000_000  # of a file unpacked: what fits into a browser with its copies
_OUT = Path("multipos-downloads")


@dataclass
class Visit:
    """One visitor: the calibration of now, and what it was made from."""

    calibration: Calibration | None = None
    kind: str = ""
    name: str = "calibration"

    def answer(self, request: str) -> str:
        """Return the answer to a request; what is at fault with it is its `error`."""
        asked = json.loads(request)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                found = getattr(self, f"_{asked['do']}")(asked)
        except (MultiposError, UsageError) as error:
            found = {"error": str(error)}
        except MemoryError:
            found = {"error": "The data do not fit into memory; give fewer rows."}
        except ImportError as error:  # of what the runtime does not carry
            name = error.name or str(error)
            said = f"This takes {name}, which the page lacks; use multipos on your machine."
            found = {"error": said}
        except Exception as error:
            said = f"{type(error).__name__}: {error}; a fault of multipos {__version__}."
            found = {"error": said}
        return json.dumps(plain(found), allow_nan=False)

    def _calibrate(self, asked: Mapping[str, Any]) -> dict[str, Any]:
        self.calibration = None
        paths = [str(name) for name in asked["files"]]
        unit = asked["unit"] or None
        for path in paths:
            _refuse_large(path)
        outputs = asked.get("outputs", "").strip() or None
        self.kind, source = _chosen(paths, asked["kind"], unit, outputs)
        if isinstance(source, Readings):
            self.calibration = fit(source, unknown_orientation=self.kind == "free")
        else:
            self.calibration = calibrate(*source, unit=unit, outputs=outputs)
        self.name = Path(paths[0]).name.partition(".")[0] or "calibration"
        return self._shown()

    def _shown(self) -> dict[str, Any]:
        """Return everything that the page shows of the calibration."""
        calibration = self._made()
        return {
            "kind": self.kind,
            "unit": calibration.model.unit,
            "sentence": calibration_sentence(calibration),
            "findings": [finding.to_dict() for finding in calibration.findings],
            "parameters": [
                {key: getattr(p, key) for key in ("name", "value", "u", "U", "unit", "label")}
                for p in calibration.entries
            ],
            "positions": _positions(calibration),
            "positions_title": f"Positions, {calibration.field.towards} in case axes",
            "next": _next(calibration),
        }

    def _targets(self, asked: Mapping[str, Any]) -> dict[str, Any]:
        """Return why a target is refused, by its name."""
        refused = {}
        for name in TARGETS:
            try:
                export(self._made(), name)
            except MultiposError as error:
                refused[name] = str(error)
        return {"refused": refused}

    def _download(self, asked: Mapping[str, Any]) -> dict[str, Any]:
        """Write one form of the calibration, and return where."""
        calibration, form = self._made(), asked["form"]
        _OUT.mkdir(exist_ok=True)
        if form == "json":
            path = _OUT / f"{self.name}.json"
            calibration.save(path)
        elif form == "readings":
            path = _OUT / f"{self.name}_readings.csv"
            write_table(path, calibration.readings.columns())
        elif form == "md":
            path = _OUT / f"{self.name}.md"
            report(calibration, path)
        else:
            path = _OUT / f"{self.name}{_SUFFIX[form]}"
            accepted = bool(asked.get("accept"))
            made = export(calibration, form, allow_lossy=accepted, force=accepted)
            made.save(path)
        return {"path": str(path), "name": path.name}

    def _plan(self, asked: Mapping[str, Any]) -> dict[str, Any]:
        """Return the best positions among faces, edges and corners, which a hand finds."""
        found = design(
            asked["model"],
            int(asked["positions"]),
            candidates="all-26",
            unknown_orientation=bool(asked["hand_held"]),
        )
        path = _OUT / "scheme.csv"
        _OUT.mkdir(exist_ok=True)
        write_table(path, found.columns())
        share = f"{100.0 * found.efficiency:.0f}"
        said = (
            f"{len(found.positions)} positions for the model {found.model}: {share} % of the "
            "precision of the best scheme there could be."
        )
        positions = [
            {"position": str(i), "direction": up, "words": pose_words(up)}
            for i, up in enumerate(found.positions, 1)
        ]
        return {"sentence": said, "positions": positions, "path": str(path), "name": path.name}

    def _apply(self, asked: Mapping[str, Any]) -> dict[str, Any]:
        """Write a log with the compensated force beside its columns, and return where."""
        if asked["calibration"]:
            calibration = load(asked["calibration"])
        else:
            calibration = self._made()
        source = Path(asked["files"][0])
        _refuse_large(str(source))
        found = apply(calibration, str(source), tilt=bool(asked["tilt"]))
        path = _OUT / f"{source.name.partition('.')[0]}_compensated.csv"
        _OUT.mkdir(exist_ok=True)
        write_table(path, found)
        said = f"{len(found['outside'])} rows compensated."
        noted = [each.text for each in serious(found.findings)]
        return {"sentence": " ".join([said, *noted]), "path": str(path), "name": path.name}

    def _made(self) -> Calibration:
        if self.calibration is None:
            raise MultiposError("there is no calibration yet; give readings first.")
        return self.calibration


def _chosen(
    paths: list[str], kind: str, unit: str | None, outputs: str | None
) -> tuple[str, Readings | list[str]]:
    """Return the kind of data, and the readings of a table, or the logs.

    Raises
    ------
    MultiposError
        No readings or no such kind can be made of them.
    """
    if kind == "log" or (kind == "auto" and (len(paths) > 1 or not _is_short_table(paths[0]))):
        return "log", paths
    readings = _with_unit(_read(paths[0], unit, outputs))
    known = readings.up is not None or readings.force is not None
    by_faces = kind == "auto" and not known and not _is_magnetic(readings)
    faces = _faces(readings) if kind == "six" or by_faces else None
    if kind == "auto":
        kind = "known" if known else "free" if faces is None else "six"
    if kind == "six":
        if faces is None:
            raise MultiposError(
                "these rows are not six faces: each needs one axis near vertical, and all three "
                "must be seen up and down; choose hand-held."
            )
        readings = replace(readings, up=faces, rotation=None)
    return kind, readings


def _refuse_large(path: str) -> None:
    """Refuse a packed file that would not fit into memory when it is unpacked."""
    size = 0
    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
    elif first_bytes(path, 2) == b"\x1f\x8b":
        size = int.from_bytes(Path(path).read_bytes()[-4:], "little")
    if size > _MOST_BYTES:
        raise MultiposError(
            f"{path} has {size / 1e6:.0f} MB unpacked, and this page takes "
            f"{_MOST_BYTES / 1e6:.0f} MB: use multipos calibrate on your machine."
        )


def _is_short_table(path: str) -> bool:
    """Tell whether a file is text of no more rows than a table of means has."""
    with Path(path).open("rb") as stream:
        head = stream.read(1 << 16)
        rest = stream.read(1)
    return b"\0" not in head and not rest and head.count(b"\n") <= _MOST_READINGS


def _read(path: str, unit: str | None, outputs: str | None) -> Readings:
    """Return readings; a table without a header, or with blanks between its cells, as of a log."""
    lines = Path(path).read_text(encoding="utf-8", errors="replace").splitlines()
    first = next((line for line in lines if line.strip() and line[0] not in "#%/"), "")
    if any(letter.isalpha() for letter in first) and any(mark in first for mark in ",;\t"):
        return read_readings(path, unit=unit, outputs=outputs)
    columns = read_log(open_log(path))
    if list(columns) == ["1", "2", "3"] and outputs is None:
        columns = dict(zip(("ax", "ay", "az"), columns.values(), strict=True))
    return read_readings(columns, unit=unit, outputs=outputs)


def _with_unit(readings: Readings) -> Readings:
    """Return readings in the unit that they show, where none is stated."""
    if readings.unit != "reading" or readings.values.shape[1] != 3:
        return readings
    if _is_magnetic(readings):
        return in_likely_field(readings)
    likely = in_likely_unit(readings)
    whole = bool((readings.values == np.round(readings.values)).all())
    return replace(readings, unit="count") if whole and likely.unit != "g" else likely


def _is_magnetic(readings: Readings) -> bool:
    return all(component(name).magnetic for name in readings.outputs)


def _faces(readings: Readings) -> Array | None:
    """Return the up vectors (n, 3) of readings of the six faces, None where they are of others."""
    values = readings.values
    if values.shape[1] != 3 or len(values) < 6:
        return None
    low, high = values.min(axis=0), values.max(axis=0)
    if not (high > low).all():
        return None
    force = (values - (low + high) / 2.0) / ((high - low) / 2.0)
    size = np.linalg.norm(force, axis=1)
    axis = np.argmax(np.abs(force), axis=1)
    along = force[np.arange(len(force)), axis]
    if (np.abs(along) < _ALONG * size).any():
        return None
    up = np.zeros_like(force)
    up[np.arange(len(force)), axis] = np.sign(along)
    seen = {tuple(row) for row in up.tolist()}
    return up if len(seen) == 6 else None


def _positions(calibration: Calibration) -> list[dict[str, Any]]:
    """Return where each position was, and its residual [g] with its standard uncertainty."""
    reference = calibration.reference
    off, u = force_residuals(calibration)
    up = calibration.sign * reference / np.linalg.norm(reference, axis=1, keepdims=True)
    return [
        {"position": label, "direction": up[i], "residual": off[i], "residual_u": u[i]}
        | {"residual_text": calibration.field.shown(off[i])}
        for i, label in enumerate(calibration.readings.labels)
    ]


def _next(calibration: Calibration) -> list[dict[str, Any]]:
    """Return the positions that would lower u most; none where nothing predicts it."""
    try:
        best, fall = rank_positions(calibration)
    except MultiposError:
        return []
    return [
        {
            "direction": best[i],
            "fall": fall[i],
            "words": pose_words(best[i], calibration.field.towards),
        }
        for i in range(_NEXT)
    ]
