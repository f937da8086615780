"""The shape of the package: a file imports only from files above it, and starts fast."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "multipos"

# The table of contents: read downward it is the flow of a calibration. A new file or folder gets
# its place here; what is not written yet keeps its own. `__init__.py` is exempt.
ORDER = (
    "errors",
    "characters",
    "names",
    "units",
    "results",
    "quantiles",
    "records",
    "formatting",
    "pipes",
    "columns",
    "files",
    "rates",
    "attitudes",
    "scheme",
    "readings",
    "logs",
    "rests",
    "known_rests",
    "samples",
    "rest_means",
    "rest_faults",
    "matching",
    "averages",
    "averaging",
    "model",
    "instructions",
    "expressions",
    "formats",
    "extended",
    "least_squares",
    "inverse",
    "derived",
    "diagnostics",
    "calibration",
    "tilt",
    "parity",
    "closed_form",
    "identifiability",
    "known",
    "rotations",
    "ellipsoid",
    "losses",
    "problem",
    "likelihood",
    "sphere",
    "descent",
    "placement",
    "starts",
    "variances",
    "noise",
    "robustness",
    "uncertain",
    "restatement",
    "gains",
    "selection",
    "subsets",
    "model_selection",
    "information",
    "optimum",
    "exchange",
    "benches",
    "assessment",
    "travel",
    "designs",
    "prospects",
    "budgets",
    "sensitivities",
    "harmonics",
    "turntable",
    "uncertainty",
    "validity",
    "fitting",
    "criticism",
    "joint_tests",
    "profiles",
    "monte_carlo",
    "compensation",
    "single_axis",
    "temperature",
    "candidates",
    "correlation",
    "observations",
    "segment",
    "segmentation",
    "hysteresis",
    "regression",
    "piecewise",
    "validation",
    "regressing",
    "correction",
    "consistency",
    "verdicts",
    "regression_checks",
    "checks",
    "comparison",
    "simulation",
    "exporters",
    "plots",
    "sections",
    "translations",
    "findings",
    "evidence",
    "bench_evidence",
    "certificate",
    "documents",
    "reports",
    "song_qin",
    "commands",
    "cli",
    "__main__",
)
# NumPy alone starts in a tenth of the time of all of these: they are imported where they are used.
SLOW_TO_IMPORT = {"scipy", "casadi", "matplotlib", "jinja2", "rich"}
FORBIDDEN_IMPORTS = ("pickle", "scipy.stats", "matplotlib.pyplot", "pylab", "pandas")
FORBIDDEN_CALLS = {"eval", "exec"}

EXISTING = sorted(path.relative_to(PACKAGE).as_posix() for path in PACKAGE.rglob("*.py"))
ROOMS = {name: name.removesuffix(".py").partition("/")[0] for name in EXISTING}
ORDERED = [name for name in EXISTING if name != "__init__.py"]
every_file = pytest.mark.parametrize("name", EXISTING)


def parse(name: str) -> ast.Module:
    return ast.parse((PACKAGE / name).read_text(encoding="utf-8"), name)


def imported(node: ast.AST) -> Iterator[str]:
    """Yield dotted names of what an import statement brings in, `from a import b` as `a.b`."""
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names)
    elif isinstance(node, ast.ImportFrom):
        module = ".".join(filter(None, ["multipos" if node.level else "", node.module]))
        yield from (f"{module}.{alias.name}" for alias in node.names)


def all_imports(tree: ast.Module) -> list[tuple[int, str]]:
    return [(node.lineno, name) for node in ast.walk(tree) for name in imported(node)]


def start_up_imports(body: list[ast.stmt]) -> Iterator[tuple[int, str]]:
    """Yield the imports that run when the module is imported: not in functions, not for types."""
    for node in body:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        for name in imported(node):
            yield node.lineno, name
        if isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING"):
            yield from start_up_imports(node.orelse)
            continue
        for part in ("body", "orelse", "finalbody", "handlers"):
            children = getattr(node, part, [])
            if part == "handlers":
                children = [statement for handler in children for statement in handler.body]
            yield from start_up_imports(children)


def is_or_is_in(name: str, package: str) -> bool:
    return name == package or name.startswith(package + ".")


def test_every_file_has_its_place():
    assert {ROOMS[name] for name in ORDERED} <= set(ORDER)
    assert len(set(ORDER)) == len(ORDER)


@pytest.mark.parametrize("name", ORDERED)
def test_imports_only_from_files_above(name):
    room = ROOMS[name]
    above = set(ORDER[: ORDER.index(room)])
    if name != f"{room}.py":  # files of one folder may share what one of them holds
        above.add(room)
    wrong = []
    for line, target in all_imports(parse(name)):
        if not is_or_is_in(target, "multipos") or target == "multipos.__version__":
            continue
        # The bare package counts as wrong too: its public names would lead around the order.
        if target.removeprefix("multipos").lstrip(".").partition(".")[0] not in above:
            wrong.append(f"{name}:{line} imports {target}")
    assert not wrong


@every_file
def test_imports_and_calls_nothing_forbidden(name):
    tree = parse(name)
    wrong = [
        f"{name}:{line} imports {target}"
        for line, target in all_imports(tree)
        for forbidden in FORBIDDEN_IMPORTS
        if is_or_is_in(target, forbidden)
    ]
    wrong += [
        f"{name}:{line} imports {target}, which only plots may"
        for line, target in all_imports(tree)
        if is_or_is_in(target, "matplotlib") and ROOMS[name] != "plots"
    ]
    wrong += [
        f"{name}:{node.lineno} calls {node.func.id}"
        for node in ast.walk(tree)
        if isinstance(node, ast.Call)
        and isinstance(node.func, ast.Name)
        and node.func.id in FORBIDDEN_CALLS
    ]
    assert not wrong


@every_file
def test_imports_no_slow_library_at_start_up(name):
    wrong = [
        f"{name}:{line} imports {target} at module top level"
        for line, target in start_up_imports(parse(name).body)
        if target.partition(".")[0] in SLOW_TO_IMPORT
    ]
    assert not wrong


def test_the_running_package_agrees():
    paths = [name.removesuffix(".py").removesuffix("/__init__") for name in ORDERED]
    modules = ["multipos", *(f"multipos.{path.replace('/', '.')}" for path in paths)]
    code = (
        f"import importlib, sys\n"
        f"for module in {modules}: importlib.import_module(module)\n"
        f"print(sorted({SLOW_TO_IMPORT} & set(sys.modules)))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=PACKAGE.parent,
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.stdout, done.stderr) == ("[]\n", "")
