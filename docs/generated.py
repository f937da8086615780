"""The pages that the program writes of itself: `python docs/generated.py`.

`reference/commands.md` lists the options of every command, `reference/names.md` every public name
with its docstring, `reference/messages.md` every finding, `reference/errors.md` every sentence with
which a command ends. They are kept in the repository, to be
read where nothing is built, and a test holds them to the program.
"""

import argparse
import ast
import inspect
import itertools
import re
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TypeGuard

import multipos
from multipos import plots
from multipos.cli import COMMANDS, command_parser
from multipos.files.spelling import packaged_pairs
from multipos.logs import joining

FOLDER = Path(__file__).resolve().parent / "reference"
COMMANDS_HEAD = """# Commands

Every command with its options, as `multipos COMMAND --help` prints them. What the files
hold is on the page of [formats](formats.md).

A shell completes commands, options and files after `pip install 'multipos[completion]'`: put
`eval "$(register-python-argcomplete multipos)"` into `~/.bashrc` or `~/.zshrc` (in zsh after
`autoload -U bashcompinit && bashcompinit`); for fish type
`register-python-argcomplete --shell fish multipos > ~/.config/fish/completions/multipos.fish`.
"""
NAMES_HEAD = """# Names

Every public name with its docstring, as `help(mp.fit)` prints it; `mp` is `multipos`. How they go
together is on the page of [Python](api.md).
"""
MESSAGES_HEAD = """# Messages

Every [finding](#levels) that a result may have, by its code: its level, its sentences with … for
numbers and names, what it means, what to do, and an example as printed. A finding without an
action leaves nothing to do.

## Levels

A result examines itself before it is returned. Its list `findings`, in Python, in every JSON
object and in every report, has the most serious first: code, level, text, action, the positions
and outputs concerned, and p where there was a test.

- **error**: nobody should use this result. It is written and printed, the exit status is 3, and
  `export` and `calibrate --to` refuse it without `--force`.
- **warning**: about these data. U may not hold, or something is to be decided.
- **note**: nothing to decide: constant for the method, the positions or the scheme, or already in
  U.

Errors and warnings are printed on stderr, once, and are Python warnings
(`mp.CalibrationWarning`); notes are printed with `-v`, nothing with `-q`; with `--json` all are
in the object. One cause has one finding.

```python
>>> import multipos as mp
>>> readings = {"direction": ["E-U-S", "E-N-U", "D-E-S", "W-D-S", "U-W-S", "S-W-D"],
...             "ax": [-0.0094, 0.0071, -0.9965, -0.0076, 0.9965, 0.0067],
...             "ay": [-0.0058, 1.0029, 0.0064, -1.0030, 0.0073, -0.0060],
...             "az": [1.0008, -0.0016, 0.0015, 0.0032, 0.0027, -1.0008]}
>>> (finding,) = mp.fit(readings).findings
>>> finding.code, finding.level, finding.rows
('interchanged-rows', 'error', ('1', '2'))

```

Where one hypothesis explains the data (an interchange, a reversal, a factor), the text names it
with the rms before and after. It is named where chance would come so near less than once in
100,000 times, and where what it changes is no outlier afterwards.

Two readings in each other's rows, of fourteen (`python -m benchmarks.picture_findings`):

![Half a g at positions 4 and 10, nothing once exchanged back](../figures/findings.svg)

How often findings are wrong, and what no test can show, is among the [results](../results.md).

## Codes
"""
ERRORS_HEAD = """# Errors

With what is missing or wrong a command ends in one sentence, `multipos: error: …`, and with exit
status 2; Python raises `mp.MultiposError` or a kind of it. The sentence says what was found, where,
and the way out. Here are all, with … for numbers and names, by the part of the program that says
them. What a result says about itself is among the [messages](messages.md).
"""
_SENTENCE = 3  # words
_MAKING = re.compile(r"\b(?:Finding|add)\(|\b_SAID\b|\b_OF_RESTS\b")
KEPT = ("meanings.toml", "examples.toml")  # what the program's sentences do not say themselves
SECTION = re.compile(r"^(\w[\w ]*)\n-{3,}$", re.MULTILINE)


def commands_page() -> str:
    """Return the page of all commands."""
    return "\n".join([COMMANDS_HEAD, options_index(), *map(command_section, COMMANDS)])


def options_index() -> str:
    """Return index entries of all options: search leaves out words such as the `to` of `--to`."""
    actions = [action for name in COMMANDS for action in command_parser(name)._actions]
    names = {name for action in actions for name in action.option_strings if name[:2] == "--"}
    return "\n".join(["```{index} " + ", ".join(sorted(names)), "```", ""])


def command_section(name: str) -> str:
    parser = command_parser(name)
    options = [action for action in parser._actions if action.dest != "help"]
    inputs = [called(action) for action in options if not action.option_strings]
    usage = " ".join(["multipos", name, *inputs, "[options]"])
    head = [f"## multipos {name}", "", f"`{usage}`: {COMMANDS[name]}", "", "| | |", "|---|---|"]
    table = [f"| {cell(spelling(action))} | {told(action)} |" for action in options]
    return "\n".join([*head, *table, ""])


def spelling(action: argparse.Action) -> str:
    names = ", ".join(action.option_strings)
    return f"{names} {called(action)}".strip()


def called(action: argparse.Action) -> str:
    """Return what stands for the value of an option or an input, as its usage says it."""
    if action.nargs == 0:
        return ""
    choices = "|".join(map(str, action.choices or ()))
    value = action.metavar or choices or action.dest.upper()
    value = value if isinstance(value, str) else " ".join(value)
    forms = {"+": f"{value} …", "*": f"[{value} …]", "?": f"[{value}]"}
    return forms.get(str(action.nargs), value)


def told(action: argparse.Action) -> str:
    text = (action.help or "").replace("%%", "%")
    text = re.sub(r"%\((\w+)\)s", lambda found: str(getattr(action, found[1])), text)
    return text.replace("|", r"\|").replace("<", r"\<").replace("*", r"\*")


def cell(code: str) -> str:
    return "`" + code.replace("|", r"\|") + "`"


def names_page() -> str:
    """Return the page of all public names."""
    parts = [NAMES_HEAD]
    for module, prefix in ((multipos, "mp"), (plots, "plots")):
        names = sorted(set(module.__all__) - {"__version__"}, key=str.swapcase)
        parts += [described(f"{prefix}.{name}", getattr(module, name)) for name in names]
    return "\n".join(parts)


def described(name: str, thing: object) -> str:
    """Return the section of a name: its call, its docstring, and what a class can do."""
    lines = [f"## {name}", ""]
    if not inspect.isclass(thing):
        lines += ["```text", call(name, thing), "```", ""]
    lines += [as_markdown(inspect.getdoc(thing) or "")]
    methods = [] if not inspect.isclass(thing) else list(members(thing))
    if methods:
        lines += ["", "**Methods and properties**", "", *methods]
    return "\n".join(lines) + "\n"


def call(name: str, function: object) -> str:
    """Return the call without types, which the docstring says with shapes and units."""
    signature = inspect.signature(function)  # type: ignore[arg-type]
    bare = [
        parameter.replace(annotation=inspect.Parameter.empty)
        for parameter in signature.parameters.values()
    ]
    plain = str(signature.replace(parameters=bare, return_annotation=inspect.Signature.empty))
    indent = " " * (len(name) + 1)
    lines = [f"{name}("]
    for part in re.split(r"(?<=,) (?![^(]*\))", plain[1:-1]):
        if len(lines[-1]) + len(part) > 90:
            lines.append(indent)
        lines[-1] += part if lines[-1].endswith(("(", indent)) else f" {part}"
    return "\n".join(lines) + ")"


def members(thing: type) -> list[str]:
    found = []
    for owner in reversed(thing.__mro__):
        if not owner.__module__.startswith("multipos"):
            continue
        for name, member in vars(owner).items():
            plain = member.__func__ if isinstance(member, staticmethod | classmethod) else member
            known = inspect.isfunction(plain) or isinstance(plain, property)
            if name.startswith("_") or not known or not inspect.getdoc(plain):
                continue
            first = (inspect.getdoc(plain) or "").split("\n\n")[0].replace("\n", " ")
            brackets = "" if isinstance(plain, property) else "()"
            found.append(f"- `{name}{brackets}`: {first}")
    return list(dict.fromkeys(found))


def as_markdown(docstring: str) -> str:
    """Return a numpydoc docstring with bold headings, lists of parameters and fenced examples."""
    pieces = SECTION.split(docstring)
    lines = [prose(pieces[0])]
    for heading, body in zip(pieces[1::2], pieces[2::2], strict=True):
        lines += ["", f"**{heading}**", ""]
        if heading == "Examples":
            lines += ["```python", body.strip("\n"), "", "```"]
        elif heading in ("Notes", "References"):
            lines += [prose(body)]
        else:
            lines += items(body.strip("\n"))
    return "\n".join(lines)


def items(body: str) -> list[str]:
    """Return a list of what stands flush left, each with the lines below it."""
    found: list[str] = []
    for line in body.splitlines():
        if line.startswith(" ") and found:
            found[-1] += ("" if found[-1].endswith(": ") else " ") + escaped(line.strip())
        elif line.strip():
            name, colon, kind = line.partition(" : ")
            found.append(f"- `{name}`" + (f" ({escaped(kind)}): " if colon else ": "))
    return [item.rstrip(": ").rstrip() for item in found]


def prose(text: str) -> str:
    return escaped(text.strip("\n")).replace("``", "`")


def escaped(text: str) -> str:
    """Leave formulas and marks of other languages as they are printed."""
    return re.sub(r"(?<!`)([*_$<|])(?!`)", r"\\\1", text) if "`" not in text else text


def assigned(tree: ast.AST) -> dict[str, list[ast.expr]]:
    """Return what is assigned to every name of a function, wherever that is."""
    found: dict[str, list[ast.expr]] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Assign):
            for name, value in _pairs(node.targets[0], node.value):
                found.setdefault(name, []).append(value)
        elif isinstance(node, ast.AugAssign) and isinstance(node.target, ast.Name):
            texts = found.setdefault(node.target.id, [node.value])
            more = ast.BinOp(texts[-1], node.op, node.value)
            texts.append(ast.copy_location(more, node.value))
    return found


def _pairs(target: ast.expr, value: ast.expr) -> list[tuple[str, ast.expr]]:
    """Return names and what they get, also of `a, b = one, other`, unless empty as yet."""
    if isinstance(target, ast.Name):
        return [(target.id, value)]
    values = value.elts if isinstance(value, ast.Tuple) else []
    pairs = zip(target.elts if isinstance(target, ast.Tuple) else [], values, strict=False)
    return [
        (name.id, each)
        for name, each in pairs
        if isinstance(name, ast.Name) and not (isinstance(each, ast.Constant) and not each.value)
    ]


def texts_of(node: ast.expr, names: dict[str, list[ast.expr]], put_in: str) -> list[str]:
    """Return the texts that an expression may be, numbers and names put in."""
    match node:
        case ast.Constant(value=str(text)):
            return [text]
        case ast.JoinedStr(values=parts):
            each = [texts_of(part, names, put_in) for part in parts]
            return ["".join(choice) for choice in itertools.product(*each)]
        case ast.FormattedValue(value=value):
            return texts_of(value, names, put_in)
        case ast.IfExp(body=one, orelse=other):
            return texts_of(one, names, put_in) + texts_of(other, names, put_in)
        case ast.BinOp(left=left, right=right):
            pairs = itertools.product(texts_of(left, names, put_in), texts_of(right, names, put_in))
            return [a + b for a, b in pairs]
        case ast.Dict(values=values):
            return [text for value in values for text in texts_of(value, names, put_in)]
        case ast.Name(id=name) if name in names:
            rest = {other: values for other, values in names.items() if other != name}
            return [text for value in names[name] for text in texts_of(value, rest, put_in)]
        case ast.Subscript(value=value):
            return texts_of(value, names, put_in)
    return [put_in]


@dataclass(frozen=True)
class Message:
    """A finding as the program makes it: its codes, levels, texts and actions."""

    codes: tuple[str, ...]
    levels: tuple[str, ...]
    texts: tuple[str, ...]
    actions: tuple[str, ...]


def messages(files: Iterable[Path], put_in: str) -> Iterator[Message]:
    """Yield every finding that is made in files, something put in for numbers and names."""
    for path in files:
        if _MAKING.search(path.read_text("utf-8")):  # most files make none
            yield from _messages_in(path, put_in)
    yield from _of_rests(put_in)


def _messages_in(path: Path, put_in: str) -> Iterator[Message]:
    tree, nodes = parsed(path)
    functions = [node for node in nodes if isinstance(node, ast.FunctionDef)]
    yield from _said(tree, functions, put_in)
    every = [node for node in nodes if _is_made(node)]
    seen: set[int] = set()
    for part in (*_around([node.lineno for node in every], functions), tree):
        within = every if part is tree else [n for n in ast.walk(part) if _is_made(n)]
        made = [node for node in within if id(node) not in seen]
        seen |= {id(node) for node in made}
        names = assigned(part) if made else {}
        for node in made:
            yield from _message(node, _at(node.lineno, part, names), put_in)


@cache
def parsed(path: Path) -> tuple[ast.Module, list[ast.AST]]:
    """Return the tree of a file and all its nodes, walked once."""
    tree = ast.parse(path.read_text("utf-8"))
    return tree, list(ast.walk(tree))


def _around(lines: list[int], functions: list[ast.FunctionDef]) -> list[ast.FunctionDef]:
    """Return the functions that hold one of some lines, of which few do."""
    return [f for f in functions if any(f.lineno <= n <= (f.end_lineno or 0) for n in lines)]


def _at(line: int, part: ast.AST, names: dict[str, list[ast.expr]]) -> dict[str, list[ast.expr]]:
    """Return names, with what `text` and `action` may be at a line, by each way there."""
    names = dict(names)
    ifs = [n for n in ast.walk(part) if isinstance(n, ast.If) and (n.end_lineno or 0) < line]
    for name in ("text", "action"):
        values = sorted((v for v in names.get(name, ()) if v.lineno < line), key=_line)
        if values:
            around = [n for n in ifs if n.lineno < values[-1].lineno <= (n.end_lineno or 0)]
            first = min(around or values[-1:], key=_line)
            before = [value for value in values if value.lineno < first.lineno]
            replaced = not around or bool(first.orelse)  # type: ignore[attr-defined]
            names[name] = ([] if replaced else before[-1:]) + values[len(before) :]
    return names


def _line(node: ast.AST) -> int:
    return node.lineno  # type: ignore[attr-defined, no-any-return]


def _said(tree: ast.Module, functions: list[ast.FunctionDef], put_in: str) -> Iterator[Message]:
    """Yield the warnings whose text, action and rows a function of a table `_SAID` returns."""
    for node in tree.body:
        if not isinstance(node, ast.AnnAssign) or getattr(node.target, "id", "") != "_SAID":
            continue
        assert node.value is not None
        made = {code.value: call for code, call in _items(node.value)}
        for code, call in made.items():
            body = next(f for f in functions if f.name == getattr(call, "id", ""))
            (last,) = [each.value for each in ast.walk(body) if isinstance(each, ast.Return)]
            assert isinstance(last, ast.Tuple)
            text, action, _ = (texts_of(each, assigned(body), put_in) for each in last.elts)
            yield Message((code,), ("warning",), tuple(text), tuple(action))


def _of_rests(put_in: str) -> Iterator[Message]:
    """Yield what several rests have in common, of the table beside `multipos.logs.joining`."""
    for code, said in packaged_pairs(joining.__file__, "of_rests.csv").items():
        fact, _, action = said.partition("|")
        text = f"{put_in} of {put_in} rests {fact}: positions {put_in}"
        yield Message((code,), (), (text,), (action,) if action else ())


def _is_made(node: ast.AST) -> TypeGuard[ast.Call]:
    called = getattr(node.func, "id", "") if isinstance(node, ast.Call) else ""
    return called in ("Finding", "add") and len(node.args) > 2  # type: ignore[attr-defined]


def _message(node: ast.Call, names: dict[str, list[ast.expr]], put_in: str) -> Iterator[Message]:
    code, level, text, *rest = node.args
    levels = tuple(texts_of(level, {}, put_in))
    if put_in in levels:
        return  # read from a file
    actions = tuple(filter(None, texts_of(rest[0], names, put_in))) if rest else ()
    codes = texts_of(code, {}, put_in)
    if codes != [put_in]:
        yield Message(tuple(codes), levels, tuple(texts_of(text, names, put_in)), actions)
        return
    ways = {k.value: v for table in names.get("actions", ()) for k, v in _items(table)}
    for table in names.get("texts", ()):  # of one of several repairs
        for key, value in _items(table):
            do = tuple(texts_of(ways[key.value], names, put_in)) if key.value in ways else actions
            yield Message((key.value,), levels, tuple(texts_of(value, names, put_in)), do)


def _items(table: ast.expr) -> list[tuple[ast.Constant, ast.expr]]:
    assert isinstance(table, ast.Dict)
    return [
        (k, v) for k, v in zip(table.keys, table.values, strict=True) if isinstance(k, ast.Constant)
    ]


def messages_page() -> str:
    """Return the page of all findings, by their codes."""
    files = sorted((FOLDER.parents[1] / "multipos").rglob("*.py"))
    made: dict[str, list[Message]] = {}
    for message in messages(files, "…"):
        for code in message.codes:
            made.setdefault(code, []).append(message)
    known = {name: tomllib.loads((FOLDER.parent / name).read_text("utf-8")) for name in KEPT}
    return "\n".join(
        [MESSAGES_HEAD, *(_entry(code, made[code], *known.values()) for code in sorted(made))]
    )


def _entry(
    code: str, made: list[Message], meanings: Mapping[str, str], examples: Mapping[str, str]
) -> str:
    """Return what stands of one code: its sentences, meaning, actions and an example."""
    levels, texts, actions = (
        list(dict.fromkeys(re.sub("…+", "…", text) for m in made for text in getattr(m, name)))
        for name in ("levels", "texts", "actions")
    )
    texts = [text for text in texts if text != "…"]
    lines = [f"### `{code}`", "", f"*{', '.join(levels)}*", ""]
    lines += [f"- {escaped(text)}" for text in texts]
    lines += [""] if texts else []
    lines += [meanings[code], ""] if code in meanings else []
    lines += [f"**Do:** {' / '.join(map(escaped, actions))}", ""] if actions else []
    if code in examples:
        lines += ["```text", examples[code], "```", ""]
    return "\n".join(lines)


def is_said(example: str, texts: Iterable[str]) -> bool:
    """Return whether a sentence with its numbers is one that the program makes."""
    patterns = (".+".join(map(re.escape, re.split("…+", text))) for text in texts)
    return any(re.fullmatch(pattern, example) for pattern in patterns)


def errors_page() -> str:
    """Return the page of all sentences with which a command ends."""
    package = FOLDER.parents[1] / "multipos"
    parts: dict[str, set[str]] = {}
    for path in sorted(package.glob("*/**/*.py")):
        room = path.relative_to(package).parts[0].replace("_", " ")
        said = parts.setdefault(room, set())
        if "raise " in path.read_text("utf-8"):
            said.update(_raised(*parsed(path)))
    sections = [
        "\n".join([f"## {room.capitalize()}", "", *(f"- {escaped(text)}" for text in sorted(said))])
        for room, said in parts.items()
        if said
    ]
    return "\n\n".join([ERRORS_HEAD.rstrip("\n"), *sections]) + "\n"


def _raised(tree: ast.Module, nodes: list[ast.AST]) -> Iterator[str]:
    """Yield the texts of what a module raises, where they are sentences."""
    constants = [node for node in tree.body if isinstance(node, ast.Assign)]
    kept = assigned(ast.Module(constants, []))
    lines = [node.lineno for node in nodes if isinstance(node, ast.Raise)]
    for function in _around(lines, [each for each in nodes if isinstance(each, ast.FunctionDef)]):
        names = kept | assigned(function)
        for node in ast.walk(function):
            if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call) and node.exc.args:
                for text in texts_of(node.exc.args[0], names, "…"):
                    if len(re.findall(r"[a-z]{2,}", text)) > _SENTENCE:
                        yield re.sub("…+", "…", text)


def main() -> None:
    (FOLDER / "errors.md").write_text(errors_page(), encoding="utf-8")
    (FOLDER / "commands.md").write_text(commands_page(), encoding="utf-8")
    (FOLDER / "names.md").write_text(names_page(), encoding="utf-8")
    (FOLDER / "messages.md").write_text(messages_page(), encoding="utf-8")


if __name__ == "__main__":
    main()
