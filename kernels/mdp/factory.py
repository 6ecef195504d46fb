"""Kernels made of a task's functions: their options and names, and the unrolling of their loops over terms."""

import ast
import hashlib
import inspect
import linecache
import textwrap
from collections.abc import Callable
from types import FunctionType
from typing import Any

import warp as wp

FAST: dict[str, Any] = {"enable_backward": False, "fast_math": True}
"""Warp module options; fast_math: GPU divisions, roots, exponentials are exact to 2 units in the last place."""

_definitions: dict[str, list] = {}  # structs by their key, in the order of their definitions


def kernel_name(name: str, *structs: Any) -> str | None:
    """Return a kernel name that distinguishes structs of equal names, or None where Warp's default name suffices.

    If a struct is defined again, for example in a notebook's cell, its kernels need another name. Otherwise Warp
    returns the kernels with equal code, whose arguments have the earlier struct.
    """
    numbers = []
    for struct in structs:
        known = _definitions.setdefault(struct.key, [])
        if not any(struct is other for other in known):
            known.append(struct)
        numbers.append(next(i for i, other in enumerate(known) if struct is other))
    return "_".join([name, *map(str, numbers)]) if any(numbers) else None


def unrolled_kernel(function: Callable[..., None], *structs: Any, options: dict[str, Any] = FAST) -> wp.Kernel:
    """Return the kernel of a Python function whose loops over terms are `unrolled`; structs: see `kernel_name`."""
    name = kernel_name(function.__name__, *structs)
    return wp.kernel(unrolled(function), name=name, module="unique", module_options=options)


def _written_out(node: Any, names: dict[str, Any], values: dict[str, int]) -> Any:
    """Return a copy of a syntax tree, or a list of them, in which loops are replaced by copies of their bodies.

    A loop is replaced by copies of its body, one a value, if its `wp.static` expressions depend on the loop variable.
    An empty slice, `*p[a:a]`, is left out of a call's arguments, since Warp refuses it. names: values of the function's
    free and global names. values: values of the loop variables around the node.
    """
    if isinstance(node, list):
        parts = [_written_out(each, names, values) for each in node]
        return [each for part in parts for each in (part if isinstance(part, list) else [part])]
    if isinstance(node, ast.Name) and node.id in values:
        return ast.Constant(values[node.id])
    if isinstance(node, ast.For) and isinstance(node.target, ast.Name) and _uses_in_static(node, node.target.id):
        assert isinstance(node.iter, ast.Call)
        bounds = [_evaluated(bound, {**names, **values}) for bound in node.iter.args]
        bodies = [_written_out(node.body, names, {**values, node.target.id: value}) for value in range(*bounds)]
        return [statement for body in bodies for statement in body]
    if isinstance(node, ast.Starred) and isinstance(node.value, ast.Subscript):
        ends = node.value.slice
        if _evaluated(ends.lower, {**names, **values}) == _evaluated(ends.upper, {**names, **values}):
            return []
    if not isinstance(node, ast.AST):
        return node
    return type(node)(**{field: _written_out(child, names, values) for field, child in ast.iter_fields(node)})


def _evaluated(bound: ast.expr, names: dict[str, Any]) -> int:
    """Return the integer that a loop's bound evaluates to, a constant or `wp.static(...)`."""
    inner = bound.args[0] if isinstance(bound, ast.Call) else bound
    return eval(compile(ast.Expression(inner), "<bound of a loop>", "eval"), names)


def _uses_in_static(loop: ast.For, name: str) -> bool:
    """Return whether a loop contains a `wp.static` expression that uses a name."""
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
    source = ast.unparse(ast.fix_missing_locations(_written_out(definition, names, {}))) + "\n"
    file = f"<{function.__module__}.{function.__name__} {hashlib.sha256(source.encode()).hexdigest()[:16]}>"
    linecache.cache[file] = (len(source), None, source.splitlines(keepends=True), file)  # for Warp, which reads sources
    exec(compile(source, file, "exec"), names)
    copied = names[function.__name__]
    copied.__annotations__, copied.__qualname__ = function.__annotations__, function.__qualname__
    return copied
