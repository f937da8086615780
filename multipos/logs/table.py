"""What every reader gives: a table of samples that comes in pieces."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import field, replace
from typing import NamedTuple

from multipos.errors import MultiposError
from multipos.files.spelling import near
from multipos.files.tables import Table
from multipos.finding import Findings
from multipos.results import frozen


class Piece(NamedTuple):
    """Consecutive rows of a log."""

    table: Table  # the columns that were asked for: numbers, and texts
    lines: Callable[[], list[str]] | None  # gives the rows as they stand in a text file
    done: float  # how much of the log has been read, 0 to 1


class Wanted(NamedTuple):
    """What is read of rows, as `Log.read` has it."""

    names: tuple[str, ...]
    optional: tuple[str, ...] = ()
    texts: tuple[str, ...] = ()
    lenient: bool = False

    @property
    def numbers(self) -> tuple[str, ...]:
        """Columns that are read as numbers."""
        return tuple(dict.fromkeys((*self.names, *self.optional)))


ReadPieces = Callable[[Wanted], Iterator[Piece]]  # from the beginning of a log


@frozen(eq=True)
class Log:
    """A log that can be read from its beginning, more than once.

    Attributes
    ----------
    source : str
    columns : tuple of str
        Their names, without the units behind them.
    numeric : tuple of str
        Columns whose first rows hold numbers, or dates, which are read as seconds since 1970.
    delimiter : str
        What stands between the cells of the text; '' is white space; ',' where it is no text.
    text : bool
        Whether pieces have rows of text.
    pieces : callable
        What `read` calls.
    header : tuple of str
        The names as they stand in the log.
    units : mapping of str to str
        Of the columns whose unit the header tells.
    rising : bool
        Whether the first of columns without names goes up, and not by ones, as a time does.
    headless : bool
        Whether nothing names the columns, which have their numbers.
    nameless : frozenset of str
        Columns that the header leaves without a name; here they have their number.
    dates : frozenset of str
        Columns of dates.
    rate : float or None [Hz]
        Sample rate that the log states of itself.
    notes : tuple of Finding
        How the table was found.
    left_out : tuple of Finding
        What of it is not read.
    registers : mapping of str to int
        The bits of columns that hold words of two's complement, which are numbers here.
    layout : str
        How its rows stand in the file, in words.
    """

    source: str
    columns: tuple[str, ...]
    numeric: tuple[str, ...]
    delimiter: str
    text: bool
    pieces: ReadPieces
    header: tuple[str, ...]
    units: Mapping[str, str] = field(default_factory=dict)
    rising: bool = False
    headless: bool = False
    nameless: frozenset[str] = frozenset()
    dates: frozenset[str] = frozenset()
    rate: float | None = None
    notes: Findings = ()
    left_out: Findings = ()
    registers: Mapping[str, int] = field(default_factory=dict)
    layout: str = "columns"

    def read(
        self,
        names: Sequence[str],
        optional: Sequence[str] = (),
        texts: Sequence[str] = (),
        *,
        lenient: bool = False,
    ) -> Iterator[Piece]:
        """Yield pieces with columns.

        A cell of `names` that is no finite number is an error, in `optional` it is NaN; `texts`
        stay text. Where it is lenient, a row with too few or too many cells has no numbers and no
        texts.
        """
        return self.pieces(Wanted(tuple(names), tuple(optional), tuple(texts), lenient))

    def find(self, name: str) -> str:
        """Return the column of a name, given with or without its unit, in letters of any case.

        Raises
        ------
        MultiposError
            There is none.
        """
        if name in self.columns:
            return name
        folded = name.casefold()
        for known in (self.header, self.columns):
            found = [i for i, other in enumerate(known) if folded == other.casefold()]
            if len(found) == 1:
                return self.columns[found[0]]
        raise MultiposError(
            f"{self.source}: no column '{name}'{near(name, self.columns)} The columns are "
            f"{', '.join(self.columns)}."
        )


def called_as(log: Log, given: Sequence[str]) -> Log:
    """Return a log whose columns have the given names, in letters of whatever case.

    The header, and rows of text, stay as they are.
    """
    own: dict[str, str] = {}  # a given name -> as the log has it
    for name in given:
        equal = [each for each in log.columns if each.casefold() == name.casefold()]
        if name not in log.columns and len(equal) == 1:
            own[name] = equal[0]
    if not own:
        return log
    new = {old: name for name, old in own.items()}

    def called(names: Sequence[str]) -> tuple[str, ...]:
        return tuple(new.get(name, name) for name in names)

    def read(wanted: Wanted) -> Iterator[Piece]:
        asked = [tuple(own.get(name, name) for name in part) for part in wanted[:3]]
        for piece in log.read(*asked, lenient=wanted.lenient):
            yield piece._replace(table=piece.table.renamed(new))

    return replace(
        log,
        columns=called(log.columns),
        numeric=called(log.numeric),
        units={new.get(name, name): unit for name, unit in log.units.items()},
        nameless=frozenset(called(tuple(log.nameless))),
        dates=frozenset(called(tuple(log.dates))),
        pieces=read,
    )
