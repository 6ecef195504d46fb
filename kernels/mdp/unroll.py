"""Kernel functions with written-out loops, whose hash Warp computes without building the kernel."""

import ast
import copy
import hashlib
import inspect
import linecache
import textwrap
from collections.abc import Callable
from types import FunctionType
from typing import Any


class _Unroller(ast.NodeTransformer):
    """Replaces a loop by copies of its body, one a value, if its `wp.static` expressions depend on the loop variable.

    names: values of the function's free and global names.
    """

    def __init__(self, names: dict[str, Any]) -> None:
        self._names = names

    def visit_For(self, node: ast.For) -> Any:
        """Return the statements in place of a loop over a range whose bounds are static."""
        if not isinstance(node.target, ast.Name) or not _uses_in_static(node, node.target.id):
            return self.generic_visit(node)
        assert isinstance(node.iter, ast.Call)
        statements = []
        for value in range(*map(self._evaluate, node.iter.args)):
            for statement in copy.deepcopy(node.body):
                new = self.visit(_Substitution(node.target.id, value).visit(statement))
                statements += new if isinstance(new, list) else [new]
        return statements

    def _evaluate(self, node: ast.expr) -> int:
        """Return the value of a bound, a constant or `wp.static(...)`."""
        inner = node.args[0] if isinstance(node, ast.Call) else node
        return eval(compile(ast.Expression(inner), "<bound of a loop>", "eval"), self._names)


class _Substitution(ast.NodeTransformer):
    """Replaces a name by a constant."""

    def __init__(self, name: str, value: int) -> None:
        self._name, self._value = name, value

    def visit_Name(self, node: ast.Name) -> ast.expr:
        """Return the constant in place of the name, any other name unchanged."""
        return ast.copy_location(ast.Constant(self._value), node) if node.id == self._name else node


def _uses_in_static(loop: ast.For, name: str) -> bool:
    """Return whether a `wp.static` expression in a loop contains a name."""
    statics = [
        node
        for node in ast.walk(loop)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "static"
    ]
    return any(isinstance(node, ast.Name) and node.id == name for static in statics for node in ast.walk(static))


def unrolled(function: Callable[..., None]) -> Callable[..., None]:
    """Return a copy of a kernel's Python function in which loops over `wp.static` expressions are written out.

    Warp evaluates a static expression with a loop variable only when it builds the kernel, and must therefore build it
    to find its binary in the cache. Static expressions without loop variables are evaluated at the definition. The
    generated code is the same. `function` is plain Python, for `wp.kernel`.
    """
    assert isinstance(function, FunctionType)
    cells = zip(function.__code__.co_freevars, function.__closure__ or (), strict=True)
    names = {**function.__globals__, **{name: cell.cell_contents for name, cell in cells}}
    tree = ast.parse(textwrap.dedent(inspect.getsource(function)))
    (definition,) = tree.body
    assert isinstance(definition, ast.FunctionDef)
    for argument in definition.args.args:
        argument.annotation = None  # evaluated already
    definition.body = _Unroller(names).visit(definition).body
    source = ast.unparse(ast.fix_missing_locations(tree)) + "\n"
    file = f"<{function.__module__}.{function.__name__} {hashlib.sha256(source.encode()).hexdigest()[:16]}>"
    linecache.cache[file] = (len(source), None, source.splitlines(keepends=True), file)  # for Warp, which reads sources
    exec(compile(source, file, "exec"), names)
    copied = names[function.__name__]
    copied.__annotations__, copied.__qualname__ = function.__annotations__, function.__qualname__
    return copied
