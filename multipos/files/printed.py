"""Lines that a program printed, as the table that they are.

A line is numbers, words and marks. Without its numbers, and the white space around its marks, it is
a form, ``ax:# ay:# az:#``; lines of one form are rows. A record of several lines is forms that
follow each other again and again. What stands before a number names it: the word before its colon
or equal sign, with the word of its group where it is a letter alone (``Accel: x=1 y=2``), or the
one before a bracket, of which three numbers are x, y, z; a word behind it, before the next mark, is
its unit. A number that nothing names and that rises is the time.

`find_printed` looks at the first lines and returns how they are printed, or None of a table, whose
cells are numbers or words and never both. `Records.text` returns the rows of lines as they come,
`unpack_printed` a file of them: each line of it is a row or empty, so that a row keeps the number
of its line. `is_row`, `is_comment` and `holds_number` tell kinds of lines.

What has a form of its own: Teleplot [1]_, ``>ax:1627551892437:0.12``, whose first number is ms; the
log of ESP-IDF [2]_, ``I (12345) imu: ax=0.1``, whose first number is ms too; stamps of ROS in
seconds and nanoseconds, which become one number. Colour codes are left out.

References
----------
.. [1] Teleplot, "Telemetry format".
.. [2] ESP-IDF programming guide, "Logging library".
"""

import os
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

from multipos.files.pipes import Unpacked, lines_of
from multipos.files.written_units import split_unit, unit_of
from multipos.results import frozen

DATE = re.compile(
    r"((\d{4}[-/]\d\d[-/]\d\d|\d\d?[/.]\d\d?[/.]\d{4})[T ])?"
    r"\d\d?:\d\d(:\d\d([.,]\d+|:\d{3})?)?\s*(Z|UTC|[+-]\d\d:?\d\d)?"
)
_PLAIN = r"[-+\u2212]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_COMMA = r"[-+\u2212]?\d+,\d+(?:[eE][-+]?\d+)?"
_LEFT_OUT = re.compile(r"\x1b\[[0-9;]*[A-Za-z]|(?<=\*)[0-9A-Fa-f]{2}\s*$")  # colours, checksums
_INDEX = r"(?<=\w)\[\d\]"  # of a name: accSmooth[0]
_LAST = 400  # lines that tell what is printed
_FEW = 8  # lines that tell a table of numbers
_NUMBERS = re.compile(r"[-+\d\s.,;:eETZ\"/]*")
_MOST = 40  # lines of a record
COMMENTS = ("#", "//", "%")
_OFTEN = 0.8  # of the lines with numbers, that have one of the forms
_TOGETHER = 1 << 16  # lines that are written at a time
_MARK = "#"  # of a number in a form
_TELEPLOT = re.compile(r">\s*([^:#]+):#(:#)?")
_ESPIDF = re.compile(r"[IWEDV] ?\(#\)")
_INTEGER = ("i", "u")  # behind whole numbers of a line protocol
_SECONDS, _NANOSECONDS = ("sec", "secs"), ("nsec", "nsecs", "nanosec", "nanosecs")
_BETWEEN = re.compile(r"[:=({\[<>|,;)}\]\"'\t]+")
_UNIT = re.compile(r"[(\[][^)\],]*[^\W\d_][^)\],]*[)\]]")  # in brackets, with a letter
_XYZ = re.compile(r"[xyz]", re.IGNORECASE)


def _number_or_date(number: str) -> str:
    """Return the pattern of what may be a cell, without groups."""
    date = re.sub(r"\((?!\?)", "(?:", DATE.pattern)
    return rf"(?<![\w.]){date}|(?<![\w.^*])(?:0[xX][0-9a-fA-F]+|{number}|nan\b|NaN\b)"


_NUMBER_OR_DATE = {",": _number_or_date(_COMMA), ".": _number_or_date(_PLAIN)}
_TOKENS = {
    decimal: re.compile(rf"(?P<index>{_INDEX})|{cell}") for decimal, cell in _NUMBER_OR_DATE.items()
}


class _Line(NamedTuple):
    """A line taken apart: the texts between its numbers, one more than these, and the numbers."""

    texts: tuple[str, ...]
    cells: tuple[str, ...]

    @property
    def form(self) -> str:
        """The line without its numbers and the white space around its marks."""
        joined = _MARK.join(re.sub(r"\s+", " ", text) for text in self.texts)
        return re.sub(r"(?<=[^\w#]) | (?=[^\w#])", "", joined.strip())


def _taken_apart(line: str, decimal: str) -> _Line:
    line = _LEFT_OUT.sub("", line).rstrip()
    texts, cells, begin = [], [], 0
    for found in _TOKENS[decimal].finditer(line):
        if not found["index"]:
            texts.append(line[begin : found.start()])
            cells.append(found[0].strip())
            begin = found.end()
    return _Line((*texts, line[begin:]), tuple(cells))


@frozen
class Printed:
    """How the records of a text are printed.

    Attributes
    ----------
    forms : tuple of str
        Of the lines of a record that hold numbers, in their order.
    names : tuple of str
        Of the numbers of a record that are kept, with their units in brackets; '' names none.
    kept : tuple of int
        Which of all numbers of a record these are.
    stamp : tuple of int
        The places among all numbers of seconds and of nanoseconds, which become one; empty without.
    decimal : str
        The decimal mark.
    """

    forms: tuple[str, ...]
    names: tuple[str, ...]
    kept: tuple[int, ...]
    stamp: tuple[int, ...]
    decimal: str

    @property
    def said(self) -> str:
        """How lines were read, in words."""
        lines = f"a record is {len(self.forms)} lines" if self.forms[1:] else "a line is a record"
        return f"{lines}, as a program printed it: {self.forms[0][:60]}"

    def row(self, cells: Sequence[str]) -> list[str]:
        """Return the cells that are kept of all of a record."""
        cells = [*cells]
        if self.decimal == ",":
            cells = [cell.replace(",", ".") for cell in cells]
        if self.stamp:
            seconds, rest = self.stamp
            cells[seconds] = f"{cells[seconds]}.{cells[rest]:0>9}"
        return [cells[place] for place in self.kept]


class Records:
    """The records of lines that come one after the other."""

    def __init__(self, printed: Printed) -> None:
        """Begin before the first record."""
        self._printed = printed
        self._lines = [_pattern(form, printed.decimal) for form in printed.forms]
        self._held: list[str] = []
        self._due = 0  # line of the record that comes next

    def text(self, lines: Iterable[str]) -> Iterator[str]:
        """Yield each line as the cells of the record that it ends, empty where it ends none."""
        for line in lines:
            yield line.rstrip() if is_comment(line) else "\t".join(self._taken(line))

    def _taken(self, line: str) -> list[str]:
        """Take up a line; return the cells of the record that it ends."""
        line = (_LEFT_OUT.sub("", line) if "\x1b" in line or "*" in line else line).strip()
        found = self._lines[self._due].fullmatch(line)
        if found is None and self._due and (found := self._lines[0].fullmatch(line)):
            self._held, self._due = [], 0  # the record before is not whole
        if found is None:
            return []
        self._held += [cell.strip() for cell in found.groups()]
        self._due += 1
        if self._due < len(self._lines):
            return []
        cells = self._printed.row(self._held)
        self._held, self._due = [], 0
        return cells


def _pattern(form: str, decimal: str) -> re.Pattern[str]:
    """Return the pattern of lines of a form, its numbers as groups."""
    parts = []
    for part in re.findall(r"\w+|\s|\W", form):
        if part == _MARK:
            parts.append(f"({_NUMBER_OR_DATE[decimal]})")
        elif part.isspace():
            parts.append(r"\s+")
        else:
            parts.append(part if part.isalnum() else rf"\s*{re.escape(part)}\s*")
    return re.compile("".join(parts).replace(r"\s*\s*", r"\s*"))


def is_comment(line: str) -> bool:
    """Tell whether a line is a comment."""
    return line.lstrip().startswith(COMMENTS)


def is_row(line: str) -> bool:
    """Tell whether a line is neither empty nor a comment."""
    return bool(line.strip()) and not is_comment(line)


def find_printed(lines: Sequence[str]) -> Printed | None:
    """Return how lines are printed; None where they are a table, or nothing that is seen."""
    sample = list(filter(is_row, lines))
    if all(map(_NUMBERS.fullmatch, sample[-_FEW:])):
        return None
    if _is_table(sample):
        return None
    begin, sample = sample[:_MOST], sample[-_LAST:]
    parts = [_taken_apart(line, ".") for line in sample]
    decimal = "," if _has_decimal_commas(parts) else "."
    if decimal == ",":
        parts = [_taken_apart(line, decimal) for line in sample]
    record = _record_of(parts, [_taken_apart(line, decimal).form for line in begin])
    if record is None or not any(_is_printed(line) for line in record):
        return None
    return _named(record, parts, decimal)


def _is_table(lines: Sequence[str]) -> bool:
    """Tell whether the first line names as many columns as all others have cells."""
    head, rows = lines[0], lines[1 : 1 + _LAST]
    if not rows or holds_number(_UNIT.sub("", head)):
        return False
    mark = next((mark for mark in ",;\t|" if mark in head.lstrip(" |")), "")
    if not mark:
        return not any(re.search(r"[:=,;\t|]", line) for line in lines[: 1 + _LAST])
    even = sum(line.rstrip(f" {mark}").count(mark) == head.count(mark) for line in rows)
    return even >= _OFTEN * len(rows)


def holds_number(line: str) -> bool:
    """Tell whether a line has a number that is not part of a word."""
    return _TOKENS["."].search(line) is not None


def _has_decimal_commas(parts: Sequence[_Line]) -> bool:
    """Tell whether every name has two numbers with only a comma between, as in ``x: 0,12``."""
    numbered = [line for line in parts if line.cells]
    if not numbered:
        return False
    for line in numbered:
        between = line.texts[1:-1]
        if len(between) % 2 == 0 or any(text != "," for text in between[::2]):
            return False
        if any(not re.search(r"[^\W\d]", text) for text in (line.texts[0], *between[1::2])):
            return False
    return True


def _record_of(parts: Sequence[_Line], begin: Sequence[str]) -> list[_Line] | None:
    """Return the lines of a whole record, None where lines follow no form; how the text begins."""
    forms = [line.form for line in parts]
    numbered = Counter(form for form, line in zip(forms, parts, strict=True) if line.cells)
    if not numbered:
        return None
    usual, most = numbered.most_common(1)[0]
    if 2 * most > numbered.total():
        return [parts[len(forms) - 1 - forms[::-1].index(usual)]]
    often = {form: count for form, count in Counter(forms).items() if count >= max(2, most / 9)}
    covered = sum(count for form, count in numbered.items() if form in often)
    return _cycle(parts, (*begin, *forms), often) if covered >= _OFTEN * numbered.total() else None


def _cycle(
    parts: Sequence[_Line], forms: Sequence[str], often: Mapping[str, int]
) -> list[_Line] | None:
    """Return the lines of a record, from one line of its first rare form to the next."""
    rare = {form for form, count in often.items() if count <= min(often.values()) + 1}
    first = next(form for form in forms if form in rare)
    forms = [line.form for line in parts]
    begins = [place for place, form in enumerate(forms) if form == first]
    spans = [(*forms[begin:end],) for begin, end in pairwise(begins)]
    usual = Counter(spans).most_common(1)
    if not usual or 2 * usual[0][1] < len(spans) or len(usual[0][0]) > _MOST:
        return None
    begin = begins[spans.index(usual[0][0])]
    return [*parts[begin : begin + len(usual[0][0])]]


def _is_printed(line: _Line) -> bool:
    """Tell whether a line is none of a table: a cell of it has a word or bracket and a number."""
    if _ESPIDF.match(line.form) or line.form.startswith(">"):
        return bool(line.cells)
    bare = re.sub(r"[\"']", "", line.form[:4000])  # the search takes their square
    if re.search(rf"[>|]|{_MARK}\*$", bare):
        return bool(line.cells)
    if re.search(rf"[^\W#][^,;#]*[:=]\s*[(\[{{]*{_MARK}|[(\[{{<]{_MARK}|{_MARK}[^\W#_]", bare):
        return True
    if re.search(rf"[,;]{_MARK} [^\W\d_#][^\s,;#]*$", bare):
        return True  # a unit behind the last
    words = re.findall(r"[^\W\d#][^\s,;#]*", bare)
    pairs = re.fullmatch(rf"(?:[^\W\d#][^\s,;#]*[ ,;]{_MARK}[ ,;]?)+", bare)
    return pairs is not None and len(set(words)) == len(words) > 1


def _named(record: Sequence[_Line], parts: Sequence[_Line], decimal: str) -> Printed | None:
    """Return how a record is printed, with the names of its numbers."""
    names = _names_of(record)
    kept, stamp = [*range(len(names))], tuple[int, ...]()
    last = [name.rpartition(".")[2].casefold() for name in names]
    seconds = next((i for i, name in enumerate(last) if name in _SECONDS), None)
    rest = next((i for i, name in enumerate(last) if name in _NANOSECONDS), None)
    if seconds is not None and rest is not None:
        stamp = (seconds, rest)
        names[seconds] = "time [s]"
        kept.remove(rest)
    times = [i for i, name in enumerate(names) if name == "time [ms]"]
    for again in times[1:]:
        kept.remove(again)
    forms = tuple(line.form for line in record if line.cells)
    if len(set(forms)) < len(forms):  # lines without numbers tell where the record begins
        forms = tuple(line.form for line in record)
    found = Printed(forms, tuple(names[i] for i in kept), tuple(kept), stamp, decimal)
    return Printed(forms, _with_time(found, parts), found.kept, stamp, decimal)


def _with_time(printed: Printed, parts: Sequence[_Line]) -> tuple[str, ...]:
    """Return the names, that of the time for a number that nothing names beside some that are."""
    names = [*printed.names]
    if not any(names):
        return ()
    if not all(names):
        lines = Records(printed).text(map(_joined, parts))
        rows = [line.split("\t") for line in lines if line]
        for place, name in enumerate(names):
            if not name and _rises([row[place] for row in rows]) and "time" not in names:
                names[place] = "time"
    return tuple(_separated(names))


def _joined(line: _Line) -> str:
    pairs = zip(line.texts, (*line.cells, ""), strict=True)
    return "".join(part for pair in pairs for part in pair)


def _rises(cells: Sequence[str]) -> bool:
    """Tell whether dates, or numbers that go up."""
    try:
        values = [*map(float, cells)]
    except ValueError:
        return all(DATE.fullmatch(cell) for cell in cells)
    steps = [after - before for before, after in pairwise(values)]
    return len(steps) > 1 and min(steps) >= 0.0 and max(steps) > 0.0


def _separated(names: Sequence[str]) -> list[str]:
    """Return names, a number behind each that has stood before."""
    counts: Counter[str] = Counter()
    separated = []
    for name in names:
        counts[name] += 1
        separated.append(f"{name} {counts[name]}" if name and counts[name] > 1 else name)
    return separated


def _names_of(record: Sequence[_Line]) -> list[str]:
    """Return the names of all numbers of a record."""
    pairs: list[tuple[str, str]] = []  # group and name
    above: list[tuple[int, str]] = []  # lines without numbers that head those farther in
    for line in record:
        depth = len(line.texts[0]) - len(line.texts[0].lstrip(" -"))
        above = [(indent, head) for indent, head in above if indent < depth]
        if not line.cells:
            labels = _labels(line.texts[0])
            above += [(depth, labels[-1])] if labels else []
            continue
        head = above[-1][1] if above else ""
        pairs += [(group, name or head) for group, name in _names_in(line, head)]
    counts = Counter(name for _, name in pairs)
    return [
        f"{group}.{name}"
        if group and (counts[name] > 1 or _XYZ.fullmatch(split_unit(name)[0]))
        else name
        for group, name in pairs
    ]


def _names_in(line: _Line, group: str) -> list[tuple[str, str]]:
    """Return the group and the name of every number of a line."""
    if teleplot := _TELEPLOT.match(line.form):
        time = [("", "time [ms]")] if teleplot[2] else []
        unit = re.search(r"§([^|]+)", line.texts[-1])
        return [*time, ("", teleplot[1] + (f" [{unit[1]}]" if unit else ""))]
    units = _units_in(line)
    found: list[tuple[str, str]] = []
    before: list[str] = []
    for place, text in enumerate(line.texts[:-1]):
        if place:
            text = text.removeprefix(units[place - 1]).removeprefix("i ")
        text, own = _unit_before(text)
        labels = _labels(text)
        before.append(own if labels or not place else before[-1])
        if len(labels) > 1:
            group = labels[-2]
        found.append((group, labels[-1] if labels else ""))
        if lettered := re.fullmatch(r"(.*\w)[\s_.](?=[xyzXYZ]$)(.)", found[-1][1]):
            group = lettered[1]
            found[-1] = (group, lettered[2])
    if _ESPIDF.match(line.form):
        found[0] = ("", "time [ms]")
    found = _spread(found, line)
    pairs = zip(units, before, strict=True)
    bare = (unit.strip().strip("()[]") or above for unit, above in pairs)
    return [
        (group, f"{name} [{unit}]" if unit and name else name)
        for (group, name), unit in zip(found, bare, strict=True)
    ]


def _unit_before(text: str) -> tuple[str, str]:
    """Return what names a number without the unit in brackets at its end, and the unit."""
    found = re.fullmatch(r"(.*\w)\s*\(([^()\d]+)\)(\W*)", text, re.DOTALL)
    if found is None or unit_of(found[2]) is None:
        return text, ""
    return found[1] + found[3], found[2]


def _labels(text: str) -> list[str]:
    """Return the words in a text, those of one name together."""
    text = re.sub(_INDEX, lambda found: f"\0{found[0][1]}", text.replace("->", "|"))
    chunks = [chunk.strip(" .*-+§") for chunk in _BETWEEN.split(text)]
    if text.rstrip(" ([{\"'").endswith("=") and len(chunks) > 1:  # a name before it has no blanks
        place = max(place for place, chunk in enumerate(chunks) if chunk or not place)
        chunks[place : place + 1] = chunks[place].split()
    named = [chunk for chunk in chunks if re.search(r"^[^$]*[^\W\d_]", chunk)]
    return [re.sub("\0(.)", r"[\1]", chunk) for chunk in named]


def _units_in(line: _Line) -> list[str]:
    """Return the unit behind every number, '' where none stands there."""
    units = []
    for text in line.texts[1:]:
        found = re.match(r"\s*[(\[]?\s*[^\W\d_][\w/^²·*]{0,7}[)\]]?(?=\s*(?:[,;|)\]}\t]|$))", text)
        glued = re.match(r"[^\W\d_][\w/^²·*]{0,7}(?=[\s,;|)\]]|$)", text)
        chosen = found or glued
        units.append(chosen[0] if chosen and chosen[0] not in _INTEGER else "")
    names = [_labels(text) for text in line.texts[:1]]
    spaced = all(not re.search(r"[:=(\[]", text) for text in line.texts)
    return [""] * len(units) if spaced and names[0] else units


def _spread(found: Sequence[tuple[str, str]], line: _Line) -> list[tuple[str, str]]:
    """Return names in which those of a bracket, or behind one name, are its components."""
    result = [*found]
    place = 0
    while place < len(found):
        end = place + 1
        while end < len(found) and not found[end][1]:
            end += 1
        count = end - place
        group, name = found[place]
        if name and count > 1 and not (count == 2 and end == len(found)):
            ends = "xyz" if count == 3 else [str(i + 1) for i in range(count)]
            result[place:end] = [(group, f"{name}_{each}") for each in ends]
        place = end
    return result


def unpack_printed(path: os.PathLike[str], printed: Printed) -> Unpacked:
    """Return printed lines as a file of cells with tabulators, a line for each of theirs."""

    def lines() -> Iterator[bytes]:
        for text in Records(printed).text(lines_of(path)):
            yield f"{text}\n".encode()

    return Unpacked(str(path), lines(), ".tsv")
