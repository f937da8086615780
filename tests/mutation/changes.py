"""What can be changed in a file that computes: operators, constants, comparisons, terms, order."""

import ast
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

_OTHER: dict[type, type] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.Pow: ast.Mult,
    ast.Lt: ast.GtE,
    ast.LtE: ast.Gt,
    ast.Gt: ast.LtE,
    ast.GtE: ast.Lt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.And: ast.Or,
    ast.Or: ast.And,
}
# Whose two arguments may be interchanged.
_SYMMETRIC = ("max", "min", "maximum", "minimum", "fmax", "fmin", "hypot", "isclose", "array_equal")
_FACTOR = 1.5  # by which a number is changed that is neither 0 nor 1


@dataclass(frozen=True)
class Change:
    """One change of one place in a file.

    Attributes
    ----------
    path : Path
    line : int
    before, after : str
        The expression, as it stands and changed.
    start, end : int
        Where it stands in the encoded file.
    """

    path: Path
    line: int
    before: str
    after: str
    start: int
    end: int

    def apply(self, root: Path) -> None:
        """Write the file of a copy of the project with the change."""
        source = (root / self.path).read_bytes()
        changed = source[: self.start] + f"({self.after})".encode() + source[self.end :]
        (root / self.path).write_bytes(changed)

    def __str__(self) -> str:
        return f"{self.path}:{self.line}: {self.before}  →  {self.after}"


def changes_of(path: Path) -> list[Change]:
    """Return every change of a file's functions: not of texts, messages, types and defaults."""
    source = path.read_bytes()
    starts = [0]
    for line in source.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    found = []
    for node in _computing(ast.parse(source)):
        for other in _others(node):
            assert isinstance(node, ast.expr)
            start = starts[node.lineno - 1] + node.col_offset
            end = starts[(node.end_lineno or 0) - 1] + (node.end_col_offset or 0)
            if ast.unparse(other) != (before := ast.unparse(node)):
                found.append(Change(path, node.lineno, before, ast.unparse(other), start, end))
    return found


def _computing(tree: ast.Module) -> Iterator[ast.AST]:
    """Yield the nodes in bodies of functions, without what only speaks."""
    for function in ast.walk(tree):
        if isinstance(function, ast.FunctionDef):
            for statement in function.body:
                yield from _spoken_apart(statement)


def _spoken_apart(node: ast.AST) -> Iterator[ast.AST]:
    silent = ast.Raise | ast.JoinedStr | ast.FunctionDef | ast.AnnAssign | ast.Slice | ast.Subscript
    if isinstance(node, silent):
        if isinstance(node, ast.AnnAssign) and node.value is not None:
            yield from _spoken_apart(node.value)
        if isinstance(node, ast.Subscript):
            yield from _spoken_apart(node.value)
        return
    yield node
    for child in ast.iter_child_nodes(node):
        yield from _spoken_apart(child)


def _others(node: ast.AST) -> Iterator[ast.expr]:
    """Yield what may stand for an expression instead."""
    if isinstance(node, ast.BinOp) and type(node.op) in _OTHER:
        if _is_text(node) or _is_by_sign(node):
            return
        yield ast.BinOp(node.left, _OTHER[type(node.op)](), node.right)
        if isinstance(node.op, ast.Add | ast.Sub):
            yield node.left
    elif isinstance(node, ast.Compare) and len(node.ops) == 1 and type(node.ops[0]) in _OTHER:
        yield ast.Compare(node.left, [_OTHER[type(node.ops[0])]()], node.comparators)
    elif isinstance(node, ast.BoolOp):
        yield ast.BoolOp(_OTHER[type(node.op)](), node.values)
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.Not):
        yield node.operand
    elif isinstance(node, ast.Constant) and type(node.value) is float and node.value not in (0, 1):
        yield ast.Constant(node.value * _FACTOR)
    elif isinstance(node, ast.Call) and len(node.args) == 2 and not node.keywords:
        first, second = node.args
        symmetric = ast.unparse(node.func).rpartition(".")[2] in _SYMMETRIC
        if not (symmetric or any(isinstance(arg, ast.Starred) for arg in node.args)):
            yield ast.Call(node.func, [second, first], [])


def _is_text(node: ast.BinOp) -> bool:
    parts = [part for part in ast.walk(node) if isinstance(part, ast.Constant | ast.JoinedStr)]
    return any(isinstance(part, ast.JoinedStr) or isinstance(part.value, str) for part in parts)


def _is_by_sign(node: ast.BinOp) -> bool:
    """Tell whether a number is multiplied by or divided by a sign, which is the same."""
    by = ast.unparse(node.right).rpartition(".")[2]
    return isinstance(node.op, ast.Mult | ast.Div) and by in ("sign", "signs")
