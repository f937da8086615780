"""The package as a wheel, made of the folder that is installed: a zip file that lists itself.

`make_wheel` makes it. It leaves out what no browser can use: commands, live capture, and the files
of the page itself, which the site has beside it.
"""

import base64
import hashlib
import io
import zipfile
from pathlib import Path

from multipos import __version__

NAME = f"multipos-{__version__}-py3-none-any.whl"
_EPOCH = (1980, 1, 1, 0, 0, 0)  # the earliest date of a zip file: the same package, the same bytes
_PACKAGE = Path(__file__).resolve().parents[1]
_LEFT_OUT = {"__pycache__", "capturing", "commands", "cli.py", "__main__.py"}
_METADATA = f"""Metadata-Version: 2.1
Name: multipos
Version: {__version__}
Requires-Python: >=3.11
Requires-Dist: numpy>=1.26
"""
_WHEEL = "Wheel-Version: 1.0\nGenerator: multipos page\nRoot-Is-Purelib: true\nTag: py3-none-any\n"


def make_wheel() -> bytes:
    """Return the wheel of the package, byte for byte the same for the same package."""
    info = f"multipos-{__version__}.dist-info"
    files = {
        f"multipos/{path.relative_to(_PACKAGE).as_posix()}": path.read_bytes()
        for path in sorted(_PACKAGE.rglob("*"))
        if path.is_file() and _is_carried(path.relative_to(_PACKAGE))
    }
    files |= {f"{info}/METADATA": _METADATA.encode(), f"{info}/WHEEL": _WHEEL.encode()}
    record = "".join(f"{name},{_recorded(raw)},{len(raw)}\n" for name, raw in files.items())
    files[f"{info}/RECORD"] = f"{record}{info}/RECORD,,\n".encode()
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        for name, raw in files.items():
            entry = zipfile.ZipInfo(name, _EPOCH)
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.external_attr = 0o644 << 16
            archive.writestr(entry, raw)
    return made.getvalue()


def _is_carried(path: Path) -> bool:
    """Tell whether a file of the package goes into the wheel."""
    of_the_site = path.parts[0] == "page" and path.suffix != ".py"
    return not (_LEFT_OUT & set(path.parts) or of_the_site or path.name.startswith("."))


def _recorded(raw: bytes) -> str:
    """Return a hash as RECORD of a wheel has it."""
    digest = base64.urlsafe_b64encode(hashlib.sha256(raw).digest()).rstrip(b"=").decode()
    return f"sha256={digest}"
