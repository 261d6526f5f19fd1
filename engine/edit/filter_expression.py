"""Filter expressions: comparisons of the Gaussians' values, joined by and, or and not.

    metallic > 0.5 and not (roughness > 0.3 or z < 0)

The text is parsed as Python's grammar has it and nothing else than comparisons is carried out, so that it may
come from anybody.
"""

import ast
import math
import operator
from collections.abc import Callable, Mapping
from functools import reduce
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.core.local_origin import NO_ORIGIN, Origin, is_set
from octasplat.engine.gaussians.channels import column_names
from octasplat.engine.gaussians.materials import ALBEDO
from octasplat.engine.gaussians.model import FlatGaussians

MAX_LENGTH = 1000
_COMPARISONS: Mapping[type[ast.cmpop], Callable[[Any, Any], Any]] = {
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
}
_ADVICE = "compare numbers of the Gaussians, as in: metallic > 0.5 and not z < 0"


def expression_variables(
    gaussians: FlatGaussians, origin_world: Origin = NO_ORIGIN
) -> dict[str, Float[np.ndarray, " n"]]:
    """Return the variables of an expression, one number per Gaussian each.

    Centres are ``x``, ``y``, ``z`` in world units, ``opacity`` is in (0, 1), and channels are called as in
    files (``metallic``, ``label_0``), but for ``albedo.r``, ``albedo.g`` and ``albedo.b``, which are linear.
    """
    means = gaussians.means_world
    if is_set(origin_world):
        means = means + np.array(origin_world)  # in 64 bits
    numbers = {axis: means[:, k] for k, axis in enumerate("xyz")}
    numbers["opacity"] = gaussians.opacities
    for name, array in gaussians.channels.items():
        for k, column in enumerate(column_names(name, array.shape[1])):
            is_color = name == ALBEDO and array.shape[1] == 3
            numbers[f"{name}.{'rgb'[k]}" if is_color else column] = array[:, k]
    return numbers


def parse_filter(text: str) -> ast.expr:
    """Return the syntax tree of an expression.

    Raises:
        ConfigError: the text is none, or does more than compare and join.
    """
    if len(text) > MAX_LENGTH:
        raise ConfigError(f"An expression may have {MAX_LENGTH} characters, and this one has {len(text)}.")
    try:
        tree = ast.parse(text.strip(), mode="eval").body
        _check_node(text, tree)
    # The parser raises ValueError for NUL characters, and the last two for deep nesting.
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        raise ConfigError(f"'{text}' is no expression; {_ADVICE}.") from None
    return tree


def filter_mask(
    gaussians: FlatGaussians, text: str, origin_world: Origin = NO_ORIGIN
) -> Bool[np.ndarray, " n"]:
    """Return a mask of the Gaussians for which an expression holds.

    Args:
        gaussians: the scene.
        text: the expression.
        origin_world: where the scene has its origin in the coordinates of the user.

    Raises:
        ConfigError: the text is no expression, or names what the scene does not have.
    """
    tree = parse_filter(text)
    numbers = expression_variables(gaussians, origin_world)
    for node in ast.walk(tree):
        for part in (node.left, *node.comparators) if isinstance(node, ast.Compare) else ():
            if (name := _variable_name(part)) is not None and name not in numbers:
                raise ConfigError(f"'{text}': the scene has no {name}; it has {', '.join(numbers)}.")
    # An expression of constants alone gives a single value.
    result = np.broadcast_to(_evaluate_condition(tree, numbers), len(gaussians))
    return np.array(result, dtype=bool)


def _check_node(text: str, node: ast.expr) -> None:
    """Check that a node is one of those that :func:`_evaluate_condition` supports."""
    if isinstance(node, ast.BoolOp):
        for part in node.values:
            _check_node(text, part)
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
        _check_node(text, node.operand)
    elif isinstance(node, ast.Compare) and all(type(sign) in _COMPARISONS for sign in node.ops):
        for part in (node.left, *node.comparators):
            if _constant_value(part) is None and _variable_name(part) is None:
                raise ConfigError(f"'{text}': {ast.unparse(part)} cannot be compared; {_ADVICE}.")
    else:
        raise ConfigError(f"'{text}': {ast.unparse(node)} is no comparison; {_ADVICE}.")


def _evaluate_condition(node: ast.expr, numbers: Mapping[str, np.ndarray]) -> np.ndarray:
    if isinstance(node, ast.BoolOp):
        join = np.logical_and if isinstance(node.op, ast.And) else np.logical_or
        return np.asarray(reduce(join, (_evaluate_condition(part, numbers) for part in node.values)))
    if isinstance(node, ast.UnaryOp):
        return np.logical_not(_evaluate_condition(node.operand, numbers))
    assert isinstance(node, ast.Compare)
    sides = [_evaluate_number(part, numbers) for part in (node.left, *node.comparators)]
    signs = [_COMPARISONS[type(sign)] for sign in node.ops]
    with np.errstate(over="ignore"):  # of a number beyond those of the Gaussians, which is infinite for them
        steps = [sign(a, b) for sign, a, b in zip(signs, sides, sides[1:], strict=False)]
    return np.asarray(reduce(np.logical_and, steps))


def _evaluate_number(node: ast.expr, numbers: Mapping[str, np.ndarray]) -> float | np.ndarray:
    number = _constant_value(node)
    # Beside a Python number arrays keep their precision, so that 0.3 is what the file calls 0.3.
    return number if number is not None else numbers[_variable_name(node) or ""]


def _constant_value(node: ast.AST) -> float | None:
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.UAdd):
        inner = _constant_value(node.operand)
        return None if inner is None else -inner if isinstance(node.op, ast.USub) else inner
    if (
        isinstance(node, ast.Constant)
        and isinstance(node.value, int | float)
        and not isinstance(node.value, bool)
    ):
        try:
            return float(node.value)
        except OverflowError:  # of a whole number; one with a point is infinite, too
            return math.inf
    return None


def _variable_name(node: ast.AST) -> str | None:
    if isinstance(node, ast.Name):
        return node.id
    if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
        return f"{node.value.id}.{node.attr}"
    return None
