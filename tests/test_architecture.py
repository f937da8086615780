"""The shape of the package: rooms in their order, imports that look up, a quick start."""

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from docs_programs import load

PACKAGE = Path(__file__).resolve().parents[1] / "multipos"

# The rooms, read downward the flow of a calibration. A file imports from its own room and from the
# lines above it; what stands alone is a file beside the rooms.
ORDER = (
    ("errors", "units"),
    ("results",),
    ("numerics",),
    ("files",),
    ("finding",),
    ("positions", "regression"),
    ("logs", "sensor"),
    ("estimation", "bias_stability"),
    ("designs", "uncertainty"),
    ("diagnostics",),
    ("fitting", "compensation"),
    ("verification", "fleets", "exports"),
    ("plots",),
    ("reports",),
    ("song_qin", "capturing"),
    ("page",),
    ("commands",),
    ("cli",),
    ("__main__",),
)
# NumPy alone starts in a tenth of the time of all of these: they are imported where they are used.
SLOW_TO_IMPORT = {"scipy", "casadi", "matplotlib", "jinja2", "pandas"}
SLOW_TO_IMPORT |= {"distributed", "h5py", "openpyxl", "pyarrow", "pymavlink", "pyulog", "rosbags"}
SLOW_TO_IMPORT |= {"serial", "uncertainties", "weasyprint", "xlrd"}
FORBIDDEN_IMPORTS = ("pickle", "scipy.stats", "matplotlib.pyplot", "pylab")
OF_THE_PACKAGE = ("multipos.__version__", "multipos.names_in_stub")
FORBIDDEN_CALLS = {"eval", "exec"}

EXISTING = sorted(path.relative_to(PACKAGE).as_posix() for path in PACKAGE.rglob("*.py"))
ROOM = {name: name.removesuffix(".py").partition("/")[0] for name in EXISTING}
ORDERED = [name for name in EXISTING if name != "__init__.py"]
FACES = [name for name in EXISTING if name.endswith("/__init__.py")]
PAGES = ["README.md", "CONTRIBUTING.md"]
PAGES += sorted(
    path.relative_to(PACKAGE.parent).as_posix()
    for path in (PACKAGE.parent / "docs").rglob("*.md")
    if "_build" not in path.parts
)


def parse(name: str) -> ast.Module:
    return load("generated").parsed(PACKAGE / name)[0]


def nodes(name: str) -> list[ast.AST]:
    return load("generated").parsed(PACKAGE / name)[1]


def imported(node: ast.AST) -> Iterator[str]:
    """Yield dotted names of what an import statement brings in, `from a import b` as `a.b`."""
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names)
    elif isinstance(node, ast.ImportFrom):
        module = ".".join(filter(None, ["multipos" if node.level else "", node.module]))
        yield from (f"{module}.{alias.name}" for alias in node.names)


@cache
def all_imports(name: str) -> list[tuple[int, str]]:
    return [(node.lineno, target) for node in nodes(name) for target in imported(node)]


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


def test_no_file_imports_itself_by_way_of_others():
    """Imports in functions and for types included; files that import none that is left leave."""
    left = {name: {file_of(target) for _, target in all_imports(name)} for name in ORDERED}
    while free := [name for name, targets in left.items() if not targets & left.keys() - {name}]:
        for name in free:
            del left[name]
    assert left == {}


def file_of(target: str) -> str:
    """Return the file that an imported name stands in, or is."""
    path = target.removeprefix("multipos.").replace(".", "/")
    return f"{path}.py" if f"{path}.py" in EXISTING else f"{path.rpartition('/')[0]}.py"


def is_or_is_in(name: str, package: str) -> bool:
    return name == package or name.startswith(package + ".")


def test_every_file_has_its_place():
    rooms = [room for line in ORDER for room in line]
    assert {ROOM[name] for name in ORDERED} == set(rooms)
    assert len(set(rooms)) == len(rooms)


def test_imports_only_from_its_room_and_above():
    wrong = []
    for name in ORDERED:
        room = ROOM[name]
        line = next(i for i, rooms in enumerate(ORDER) if room in rooms)
        allowed = {room, *(other for rooms in ORDER[:line] for other in rooms)}
        for row, target in all_imports(name):
            if not is_or_is_in(target, "multipos") or target in OF_THE_PACKAGE:
                continue
            # The bare package counts as wrong too: its public names would lead around the order.
            if target.removeprefix("multipos").lstrip(".").partition(".")[0] not in allowed:
                wrong.append(f"{name}:{row} imports {target}")
    assert wrong == []


def test_a_room_says_what_it_is_for():
    lengths = {name: len(ast.get_docstring(parse(name)) or "") for name in FACES}
    assert {name: length for name, length in lengths.items() if not 0 < length < 800} == {}


def test_only_the_public_room_has_names_of_its_own():
    assert {ROOM[name] for name in FACES if all_imports(name)} == {"plots"}


def test_the_architecture_page_shows_the_rooms_as_they_are():
    rows = []
    for room in (room for rooms in ORDER for room in rooms):
        face = f"{room}/__init__.py" if (PACKAGE / room).is_dir() else f"{room}.py"
        said = ast.get_docstring(parse(face)) or ""
        (opened,) = re.findall(r"Open\s`(\w+)`", said) or [""]
        assert not opened or (PACKAGE / room / f"{opened}.py").exists()
        sentence = " ".join(said.partition("\n\n")[0].replace("``", "`").split())
        shown = f"`{room}/`" if (PACKAGE / room).is_dir() else f"`{room}.py`"
        rows.append(f"| {shown} | {sentence} | {f'`{opened}`' if opened else ''} |")
    page = (PACKAGE.parent / "docs" / "architecture.md").read_text(encoding="utf-8")
    assert re.findall(r"^\| `.*", page, re.MULTILINE) == rows


def test_pages_name_files_that_are_there():
    named = {
        (page, name)
        for page in PAGES
        for name in re.findall(
            r"`((?:multipos|tests|docs|benchmarks)/[\w/]+(?:\.\w+)?)`",
            (PACKAGE.parent / page).read_text(encoding="utf-8"),
        )
        if not re.search(r"/\d+$", name)  # schemas of files
    }
    assert [each for each in named if not (PACKAGE.parent / each[1]).exists()] == []


def test_docstrings_name_what_is_there():
    """A dotted name in backticks is public, a module, or stands at the top level of one."""
    import multipos

    public = set(multipos._PUBLIC)
    named = {
        (name, target)
        for name in EXISTING
        for target in re.findall(
            r"`multipos\.([\w.]+)`", (PACKAGE / name).read_text(encoding="utf-8")
        )
    }
    assert [each for each in named if each[1] not in public and not is_there(each[1])] == []


# Files whose docstring does not name its functions yet, or names itself: none is ever added.
UNLISTED: list[str] = []


def test_a_docstring_lists_its_functions_and_does_not_cite_itself():
    """Of more than two public functions it names two thirds; what is mended leaves the list."""
    files = [name for name in ORDERED if name not in FACES]
    assert [name for name in files if cites_itself(name) or omits_functions(name)] == UNLISTED


def cites_itself(name: str) -> bool:
    module = "multipos." + name.removesuffix(".py").replace("/", ".")
    cited = rf"\b{re.escape(module)}\b(?!\.)|(?<![\w/]){re.escape(name)}"
    return re.search(cited, ast.get_docstring(parse(name)) or "") is not None


def omits_functions(name: str) -> bool:
    said = ast.get_docstring(parse(name)) or ""
    functions = [node.name for node in parse(name).body if isinstance(node, ast.FunctionDef)]
    public = [each for each in functions if not each.startswith("_")]
    listed = [each for each in public if re.search(rf"`{each}\b", said)]
    return len(public) > 2 and 3 * len(listed) < 2 * len(public)


def is_there(target: str) -> bool:
    module, _, attribute = target.rpartition(".")
    path = PACKAGE / target.replace(".", "/")
    if path.is_dir() or path.with_suffix(".py").exists():
        return True
    while module and not (PACKAGE / f"{module.replace('.', '/')}.py").exists():
        module, _, attribute = module.rpartition(".")
    return bool(module) and attribute in top_level(f"{module.replace('.', '/')}.py")


def top_level(name: str) -> set[str]:
    found = set()
    for node in parse(name).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            found.add(node.name)
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        found |= {target.id for target in targets if isinstance(target, ast.Name)}
    return found


def test_inside_nothing_comes_through_the_face_of_a_room():
    rooms = {ROOM[name] for name in EXISTING if name.endswith("/__init__.py")} - {"__init__"}
    faces = {f"multipos.{room}" for room in rooms}
    modules = {f"multipos.{name.removesuffix('.py').replace('/', '.')}" for name in EXISTING}
    wrong = [
        f"{name}:{line} imports {target}"
        for name in EXISTING
        for line, target in all_imports(name)
        if target.rpartition(".")[0] in faces and target not in modules
    ]
    assert not wrong


def test_types_and_names_at_run_time_agree():
    import multipos

    stub = Path(multipos.__file__).with_suffix(".pyi").read_text("utf-8")
    assert len(multipos._PUBLIC) == stub.count("from multipos.")
    assert all(hasattr(multipos, name) for name in multipos.__all__)


@cache
def calls(name: str) -> list[tuple[int, str]]:
    return [
        (node.lineno, node.func.id)
        for node in nodes(name)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
    ]


def test_imports_and_calls_nothing_forbidden():
    wrong = [
        f"{name}:{line} imports {target}"
        for name in EXISTING
        for line, target in all_imports(name)
        for forbidden in FORBIDDEN_IMPORTS
        if is_or_is_in(target, forbidden)
    ]
    wrong += [
        f"{name}:{line} imports {target}, which only plots may"
        for name in EXISTING
        for line, target in all_imports(name)
        if is_or_is_in(target, "matplotlib") and ROOM[name] != "plots"
    ]
    wrong += [
        f"{name}:{line} imports {target}, which only the base of all results may"
        for name in EXISTING
        for line, target in all_imports(name)
        if is_or_is_in(target, "pandas") and ROOM[name] != "results"
    ]
    wrong += [
        f"{name}:{line} calls {target}"
        for name in EXISTING
        for line, target in calls(name)
        if target in FORBIDDEN_CALLS
    ]
    assert wrong == []


KINDLESS = ("reports",)  # rooms in which model, field and estimator answer for themselves
KIND = re.compile(r"isinstance\([^)]*Model\b|\.magnetic\b|\.exact\b|\bEstimator\.")


def test_rooms_ask_no_kind_of_model_field_or_estimator():
    texts = {name: (PACKAGE / name).read_text("utf-8") for name in EXISTING}
    asked = {name: KIND.findall(text) for name, text in texts.items() if name.startswith(KINDLESS)}
    assert not {name: questions for name, questions in asked.items() if questions}


def test_imports_no_slow_library_at_start_up():
    wrong = [
        f"{name}:{line} imports {target} at module top level"
        for name in EXISTING
        for line, target in start_up_imports(parse(name).body)
        if target.partition(".")[0] in SLOW_TO_IMPORT
    ]
    assert wrong == []


def test_data_with_arrays_are_not_compared_field_by_field():
    # The truth of an array of truths is an error; results compare themselves (`results.Result`).
    wrong = [
        f"{name}:{node.lineno} {node.name} lacks eq=False"
        for name in EXISTING
        for node in nodes(name)
        if isinstance(node, ast.ClassDef)
        and any(
            "dataclass" in (text := ast.unparse(each)) and "eq=False" not in text
            for each in node.decorator_list
        )
        and any(
            re.search(r"Array|Places", ast.unparse(field.annotation))
            for field in node.body
            if isinstance(field, ast.AnnAssign)
        )
    ]
    assert wrong == []


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


# A private word -> what the field says: never in a name or a docstring of the package.
PLAIN_WORDS = {
    "told": "identifiable, estimated or separated",
    "denied": "rejected",
    "claimed": "stated",
    "claims": "stated uncertainty",
    "believed": "prior, or accepted",
    "placement": "orientation error",
    "placed": "of uncertain orientation",
    "nest": "fixture",
    "nests": "fixtures",
    "floor": "stated variance, or lower bound",
    "in turn": "alternating",
    "sketch": "parsed model",
    "stating": "building",
    "wander": "drift",
    "appraisal": "assessment",
    "absurd": "gross error",
    "absurdities": "gross errors",
    "absurdity": "gross error",
}
# What users have these names of: `mp.capture(told=)`, and a third party's functions.
PUBLIC = {"capturing/running.py": {"told"}}
THIRD_PARTY = {"plots/svg.py": {"floor"}, "plots/style.py": {"floor"}}


def words_of(name: str) -> set[str]:
    """Return the words in the names and in the docstrings, examples apart, that a file gives."""
    found = set(re.split(r"[/._]", name))
    documented = (ast.Module, ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)
    for node in nodes(name):
        if isinstance(node, documented):
            prose = re.sub(r">>>(.+\n?)+", "", ast.get_docstring(node) or "")
            found |= set(re.findall(r"in turn|[^\W_]+", prose.lower()))
        for name in (getattr(node, key, None) for key in ("name", "id", "arg")):
            found |= set(name.lower().split("_")) if isinstance(name, str) else set()
    return found


def test_names_and_docstrings_use_the_words_of_the_field():
    kept = {**PUBLIC, **THIRD_PARTY}
    found = {name: words_of(name) & set(PLAIN_WORDS) - kept.get(name, set()) for name in EXISTING}
    assert not {name: {w: PLAIN_WORDS[w] for w in words} for name, words in found.items() if words}
