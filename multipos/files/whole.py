"""Files read whole, and written whole or not at all, several together.

`read_bytes`, `first_bytes` and `sha256_of` read; `written` has several files ready and in their
places when its block has ended well, `write_text` one; `reading` and `writing` say in one line why
a file cannot be read or written, `check_place`, `make_folder` and `no_folder` why it could not be;
`now` is the time that results carry.
"""

import os
import shutil
import stat
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

from multipos.errors import MultiposError
from multipos.files.spelling import StrPath

Content = str | bytes | Iterable[str]  # of a file: text in UTF-8, as a whole or in pieces
Pieces = Content | Iterable[bytes]


def read_bytes(path: StrPath, what: str) -> bytes:
    """Return the content of a file, or say in one line why it cannot be read."""
    with reading(path, what):
        return Path(path).read_bytes()


def sha256_of(path: StrPath, what: str) -> str:
    """Return the SHA-256 of the content of a file."""
    import hashlib  # slow to import, and a log has no need of it

    with reading(path, what), Path(path).open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def first_bytes(path: StrPath, count: int) -> bytes:
    """Return how a file begins; nothing where it cannot be read, which its reader says."""
    try:
        with Path(path).open("rb") as stream:
            return stream.read(count)
    except OSError:
        return b""


@contextmanager
def reading(path: StrPath, what: str) -> Iterator[None]:
    """Say in one line why a file cannot be read, where the block cannot."""
    try:
        yield
    except FileNotFoundError:
        raise MultiposError(f"{path}: no such file; check the path of the {what}.") from None
    except OSError as error:
        raise MultiposError(
            f"{path}: cannot read the {what}: {error.strerror or error}; "
            "check the path and its permissions."
        ) from None


def make_folder(folder: Path) -> None:
    """Make a folder and those above it where they are not, or say in one line why not."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise no_folder(folder, error) from None


def no_folder(folder: Path, error: OSError) -> MultiposError:
    """Return what is said of a folder for output that cannot be made."""
    return MultiposError(
        f"{folder}: cannot make the folder: {error.strerror}; give another with -o."
    )


class _Draft(NamedTuple):
    """A file on its way: made beside its target, or anywhere where that is no regular file."""

    path: StrPath  # as it was given
    target: Path
    temporary: Path
    regular: bool

    @property
    def before(self) -> Path:
        """What the target was, where several files must appear together."""
        return self.temporary.with_suffix(".before")


def write_text(path: StrPath, text: Content) -> None:
    """Write one file whole or not at all, as `written` does."""
    with written({path: text}):
        pass


@contextmanager
def written(files: Mapping[StrPath, Pieces]) -> Iterator[None]:
    """Have files ready when the block begins, and in their places when it has ended well.

    Each is made as a temporary neighbour that then takes its name, or not at all; several appear
    together or not at all. Where making a piece fails, or the block, nothing has been touched; but
    a device or a pipe, which nothing can take the place of, is written before the block. A
    character that UTF-8 does not have (of a file name that is no text) is written as an escape.

    Raises
    ------
    MultiposError
        A file cannot be written; existing ones are left as they were.
    """
    drafts: list[_Draft] = []
    try:
        for path, content in files.items():
            with writing(path):
                drafts.append(_draft(path))
            _fill(drafts[-1], content)
        for draft in drafts:
            if not draft.regular:
                with writing(draft.path):
                    _copy(draft.temporary, draft.target)
        yield
        _put_in_place([draft for draft in drafts if draft.regular])
    finally:
        for draft in drafts:
            draft.temporary.unlink(missing_ok=True)
            draft.before.unlink(missing_ok=True)


@contextmanager
def writing(path: StrPath) -> Iterator[None]:
    """Say in one line why a file cannot be written, where the block cannot."""
    try:
        yield
    except OSError as error:
        raise MultiposError(
            f"{path}: cannot write: {error.strerror or error}; check the folder and permissions."
        ) from None


def check_place(path: StrPath) -> None:
    """Say in one line why a file could not be written there, before any work is done for it.

    Raises
    ------
    MultiposError
    """
    with writing(path):
        _draft(path).target.parent.stat()


def _draft(path: StrPath) -> _Draft:
    """Return where a file goes: a link stays, what it points to is written."""
    regular, folder = True, os.fspath(path).endswith("/")
    with suppress(FileNotFoundError):
        mode = Path(path).stat().st_mode
        regular, folder = stat.S_ISREG(mode), folder or stat.S_ISDIR(mode)
        if not os.access(path, os.W_OK):
            raise PermissionError(None, "it is read-only")
    if folder:
        raise IsADirectoryError(None, "it is a folder")
    if not regular:
        import tempfile  # slow to import, and seldom needed

    target = Path(os.path.realpath(path) if regular else path)
    # The name is short, because that of the target may be as long as a name can be, and chosen
    # before the file is there, so that a signal in between leaves nothing behind.
    beside = target.parent if regular else Path(tempfile.gettempdir())
    return _Draft(path, target, beside / f".multipos-{os.urandom(8).hex()}", regular)


def _fill(draft: _Draft, content: Pieces) -> None:
    pieces = [content] if isinstance(content, str | bytes) else content
    with writing(draft.path):
        stream = draft.temporary.open("xb")
    with stream:
        for piece in pieces:
            raw = piece if isinstance(piece, bytes) else piece.encode("utf-8", "backslashreplace")
            with writing(draft.path):
                stream.write(raw)
        with writing(draft.path):
            stream.flush()
            if draft.regular:
                os.fsync(stream.fileno())  # or a power cut may leave an empty file in its place
            if draft.regular and draft.target.exists():
                draft.temporary.chmod(stat.S_IMODE(draft.target.stat().st_mode))


def _put_in_place(drafts: Sequence[_Draft]) -> None:
    with ExitStack() as undo:
        for draft in drafts:
            with writing(draft.path):
                if len(drafts) > 1:
                    if draft.target.exists():
                        shutil.copy2(draft.target, draft.before)
                    undo.callback(_restore, draft)
                draft.temporary.replace(draft.target)
        undo.pop_all()
    for folder in {draft.target.parent for draft in drafts}:
        _keep_names(folder)


def _keep_names(folder: Path) -> None:
    """Have the names of a folder on disk, where its system can."""
    with suppress(OSError):
        number = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(number)
        finally:
            os.close(number)


def _copy(source: Path, device: Path) -> None:
    with source.open("rb") as stream, device.open("wb") as target:
        shutil.copyfileobj(stream, target)


def _restore(draft: _Draft) -> None:
    if draft.before.exists():
        draft.before.replace(draft.target)
    elif not draft.temporary.exists():  # it had taken the place of nothing
        draft.target.unlink(missing_ok=True)


def now() -> str:
    """Return the time in UTC; SOURCE_DATE_EPOCH, where set, makes results reproducible."""
    epoch = os.environ.get("SOURCE_DATE_EPOCH")
    moment = datetime.now(UTC) if epoch is None else datetime.fromtimestamp(int(epoch), UTC)
    return moment.isoformat(timespec="seconds")
