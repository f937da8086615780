"""The files of the site: page, worker, service worker, package, and who may be asked for what.

The page draws, a worker runs the package under Pyodide, and a service worker stands between them
and the network: it lets nothing in whose hash is not the one written here, keeps all of it for the
next visit, and gives every answer its content security policy. ``site.js`` is written here and
holds what they must know of each other; the rest is as it stands in this folder.

    files     own files by name, with their hashes
    runtime   where Pyodide comes from, and its files with their hashes
    words     Chinese of every English text of the page

The package as a wheel, made of the folder that is installed: a zip file that lists itself.

It leaves out what no browser can use: commands, live capture, and the files of the page itself,
which the site has beside it.
"""

import base64
import hashlib
import io
import json
import zipfile
from html import escape
from pathlib import Path
from typing import Any, NamedTuple

from multipos import __version__
from multipos.errors import MultiposError
from multipos.files.whole import make_folder, writing, written
from multipos.page import runtime

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


MARK = "// Written by multipos page: "
_FOLDER = Path(__file__).parent
_DRAWING = _FOLDER.parent / "capturing"
_SHARED = ("drawing.js", "drawing.css")  # the page of `capture` draws with them as well
_STATIC = (
    "main.js",
    "worker.js",
    "sw.js",
    "style.css",
    "icon.svg",
    "manifest.webmanifest",
)


class Site(NamedTuple):
    """A site, complete.

    Attributes
    ----------
    files : mapping of str to bytes
        By name.
    policies : mapping of str to str
        Content security policy of the page, and of the worker.
    """

    files: dict[str, bytes]
    policies: dict[str, str]


def make_site(pyodide: str | None = None) -> Site:
    """Return the files of the site.

    Parameters
    ----------
    pyodide : str, optional
        Folder or address of the runtime; the official one where not given. That of a folder
        becomes part of the site.

    Raises
    ------
    MultiposError
        A file of the folder is missing, or is not that of this version.
    UsageError
        The address is none.
    """
    source = pyodide or runtime.OFFICIAL
    if runtime.is_address(source):
        base, origin, carried = f"{source.rstrip('/')}/", runtime.origin_of(source), {}
    else:
        base, origin = "runtime/", ""
        carried = {base + name: raw for name, raw in runtime.read_runtime(Path(source)).items()}
    policies = _policies(origin)
    files = {name: (_FOLDER / name).read_bytes() for name in _STATIC}
    files |= {name: (_DRAWING / name).read_bytes() for name in _SHARED}
    files["index.html"] = _page(policies["page"], origin)
    files["pyodide-lock.json"] = json.dumps(runtime.LOCK).encode()
    files[NAME] = make_wheel()
    known = {name: runtime.sha256(raw) for name, raw in files.items() if name != "sw.js"}
    said: dict[str, Any] = {
        "version": __version__,
        "wheel": NAME,
        "files": {name: runtime.integrity(digest) for name, digest in known.items()},
        "runtime": {
            "base": base,
            "numpy": runtime.NUMPY,
            "files": {name: runtime.integrity(digest) for name, digest in runtime.FILES.items()},
        },
        "policies": policies,
    }
    said["id"] = runtime.sha256(json.dumps(said).encode())[:16]
    text = json.dumps(said, indent=1, ensure_ascii=False)
    files["site.js"] = f"{MARK}{__version__}\nself.SITE = {text};\n".encode()
    return Site(files | carried, policies)


def write_site(folder: Path, site: Site) -> None:
    """Write a site into a folder that is new, empty or one of its own.

    Raises
    ------
    MultiposError
        The folder holds something else, or cannot be written.
    """
    check_folder(folder)
    for place in sorted({(folder / name).parent for name in site.files}):
        make_folder(place)
    with written({folder / name: raw for name, raw in site.files.items()}):
        pass
    for path in folder.glob("multipos-*.whl"):  # of another version
        if path.name not in site.files:
            path.unlink()


def check_folder(folder: Path) -> None:
    """Refuse a folder that holds what is no site."""
    with writing(folder):  # a name may be too long to ask for
        taken = folder.exists() and not folder.is_dir()
    if taken:
        raise MultiposError(f"{folder} is a file; name a folder with -o.")
    if not folder.is_dir() or not any(folder.iterdir()):
        return
    own = folder / "site.js"
    if not own.is_file() or not own.read_bytes().startswith(MARK.encode()):
        raise MultiposError(
            f"{folder} holds other files; give a folder that is new, empty or a site of multipos."
        )


def _policies(origin: str) -> dict[str, str]:
    """Return who may be asked for what: the site itself, and the runtime by the worker."""
    # The worker compiles WebAssembly. What the page itself runs is the site's own, and no more.
    asked = f"'self' {origin}".rstrip()
    common = "base-uri 'none'; form-action 'none'"
    page = (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; "
        f"connect-src {asked}; worker-src 'self'; manifest-src 'self'; {common}"
    )
    worker = (
        f"default-src 'none'; script-src {asked} 'wasm-unsafe-eval'; connect-src {asked}; {common}"
    )
    return {"page": page, "worker": worker}


def _page(policy: str, origin: str) -> bytes:
    """Return the page with its policy, and what it says of the runtime's host."""
    text = (_FOLDER / "index.html").read_text(encoding="utf-8")
    filled = text.replace("{policy}", escape(policy)).replace("{host}", escape(origin))
    return filled.encode()
