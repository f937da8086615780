"""The runtime of the page: Pyodide in one version, every file known by its hash.

`read_runtime` reads it from a folder; `is_address` and `origin_of` are of one that stands
elsewhere, `sha256` and `integrity` write a hash. Pyodide is CPython for WebAssembly. Its lock file
holds the hash of the NumPy wheel; those of the other files are of the release itself, as npm's
package ``pyodide`` carries it. A file with another hash is refused: by name here, where a folder is
copied, and by the service worker, where the runtime comes from an address.
"""

import base64
import hashlib
from pathlib import Path
from urllib.parse import urlsplit

from multipos.errors import MultiposError, UsageError
from multipos.files.whole import read_bytes

VERSION = "0.27.7"
OFFICIAL = f"https://cdn.jsdelivr.net/pyodide/v{VERSION}/full/"
NUMPY = "numpy-2.0.2-cp312-cp312-pyodide_2024_0_wasm32.whl"
# What the page fetches of a distribution, with the SHA-256 of each.
FILES = {
    "pyodide.mjs": "04c052c815abb0bf2981fa38c2dfa58e3120ee5288c956df2b2a15e301782c5f",
    "pyodide.asm.js": "6b4c90de5b7172873f04f21884d0e9d2274e305fe32116558fe3e4fbe3618d51",
    "pyodide.asm.wasm": "a50dd1843f805a0b7c45b61037ee0d7b26dfe85efe0e18ef95a34ad24e401f5f",
    "python_stdlib.zip": "16611534726e5d8ac2bd8f926410b2dcb8d6f49aa24913463533b457a2115c16",
    NUMPY: "ebb61241d962b98b21597d7ce43b67668a6d5bab3acec4fbe958657320d7cd08",
}
# Of the lock file, what the runtime itself reads; NumPy is loaded by its address.
_BUILT = ("2024_0", "wasm32", "emscripten_3_1_58", "3.12.7", VERSION)
_INFO = dict(zip(("abi_version", "arch", "platform", "python", "version"), _BUILT, strict=True))
LOCK = {"info": _INFO, "packages": {}}


def is_address(source: str) -> bool:
    """Tell whether a runtime is named by its address, not by a folder."""
    return "://" in source


def origin_of(address: str) -> str:
    """Return scheme and host of the address of a runtime.

    Raises
    ------
    UsageError
        It is no address that a content security policy can name.
    """
    parts = urlsplit(address)
    plain = parts.netloc and not set(parts.netloc) & set(" ;,'\"*")
    if parts.scheme not in ("http", "https") or not plain or parts.query or parts.fragment:
        raise UsageError(
            f"--pyodide {address}: give a folder, or an address without a query, such as "
            f"{OFFICIAL}."
        )
    return f"{parts.scheme}://{parts.netloc}"


def read_runtime(folder: Path) -> dict[str, bytes]:
    """Return the files of a runtime in a folder, by name.

    Raises
    ------
    MultiposError
        One is missing or is not the file of this version.
    """
    files = {name: read_bytes(folder / name, "runtime") for name in FILES}
    strange = [name for name, raw in files.items() if sha256(raw) != FILES[name]]
    if strange:
        raise MultiposError(
            f"{folder}: {', '.join(strange)} is not that of Pyodide {VERSION}: the hash differs; "
            "copy the release again."
        )
    return files


def sha256(raw: bytes) -> str:
    """Return the SHA-256 of bytes in hexadecimal digits."""
    return hashlib.sha256(raw).hexdigest()


def integrity(digest: str) -> str:
    """Return a SHA-256 in hexadecimal digits as browsers take it."""
    return f"sha256-{base64.b64encode(bytes.fromhex(digest)).decode()}"
