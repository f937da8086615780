"""Text in other encodings than UTF-8: UTF-16 by its first bytes, others by what they would say.

Windows and Excel write UTF-16, in China GB 18030, in western Europe Windows-1252. Bytes that are no
UTF-8 are GB 18030 where every Chinese character they would be has another beside it, as a letter
with an accent among plain ones would make single ones; else Windows-1252 where of its signs only
letters of German and French and those of units appear.
"""

import io
import os
import re
from pathlib import Path

from multipos.errors import MultiposError
from multipos.files.pipes import Unpacked

UTF_16 = (b"\xff\xfe", b"\xfe\xff")
_CHINESE = re.compile(r"[\u4e00-\u9fff]+")
_WESTERN = frozenset("äöüÄÖÜßéèêëàâçôûîïÉÈÀÇ°²³µ±·–")


def decoded(raw: bytes) -> tuple[str, str] | None:
    """Return the text that bytes are which are no UTF-8, and its encoding; None where unclear."""
    if raw.startswith(UTF_16):
        try:
            return raw.decode("utf-16"), "UTF-16"
        except UnicodeDecodeError:
            return None
    try:
        text = raw.decode("gb18030")
    except UnicodeDecodeError:
        text = ""
    runs = _CHINESE.findall(text)
    if runs and min(map(len, runs)) > 1:
        return text, "GB 18030"
    try:
        text = raw.decode("cp1252")
    except UnicodeDecodeError:
        return None
    strange = {letter for letter in text if letter > "\x7f"}
    return (text, "Windows-1252") if strange <= _WESTERN and "\0" not in text else None


def unpack_text(path: os.PathLike[str]) -> Unpacked:
    """Return a text in another encoding as one in UTF-8.

    Raises
    ------
    MultiposError
        The encoding is unclear.
    """
    found = decoded(Path(path).read_bytes())
    if found is None:
        raise MultiposError(
            f"{path}: the text is not UTF-8, nor by its marks UTF-16, GB 18030 or Windows-1252; "
            "save it as UTF-8."
        )
    return Unpacked(str(path), io.BytesIO(found[0].encode()), Path(str(path)).suffix)
