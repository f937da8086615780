"""The files of the site: page, worker, service worker, package, and who may be asked for what.

`make_site` makes them, `write_site` writes them into a folder that `check_folder` has allowed. The
page draws, a worker runs the package under Pyodide, and a service worker stands between them and
the network: it lets nothing in whose hash is not the one written here, keeps all of it for the next
visit, and gives every answer its content security policy. ``site.js`` is written here and holds
what they must know of each other; the rest is as it stands in this folder.

    files     own files by name, with their hashes
    runtime   where Pyodide comes from, and its files with their hashes
"""

import json
from html import escape
from pathlib import Path
from typing import Any, NamedTuple

from multipos import __version__
from multipos.errors import MultiposError
from multipos.files.whole import make_folder, writing, written
from multipos.page import runtime
from multipos.page.wheel import NAME, make_wheel

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
