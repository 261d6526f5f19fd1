"""Mutation testing of modules whose mistakes would go unseen: each change of their code must fail a test.

    python -m benchmarks.mutations resolver              # every mutant of a subject, and which survive
    python -m benchmarks.mutations fences --list         # the mutants alone
    python -m benchmarks.mutations reference --lines reference.py:143-190

This process collects the tests. A fork runs them once and notes the lines that each of them reaches; then
there is one for each mutant, which exchanges the code of the changed function and runs the tests that reach
the changed statement, the quickest first. Code of functions is changed, not what is evaluated at import.

Changes are of the syntax tree, and of the SQL in strings, which the usual tools leave alone. Texts with
spaces are messages and stay as they are.
"""

import argparse
import ast
import importlib.machinery
import json
import os
import re
import resource
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import FunctionType
from typing import Any

import coverage
import pytest

ROOT = Path(__file__).resolve().parent.parent
PYTEST = ("-s", "-p", "no:cacheprovider", "-p", "no:terminal", "-p", "anyio", "-o", "addopts=")
"""Without the plugins that only other tests need, see :func:`main`."""
MAX_CPU_SECONDS = 120
"""CPU time of one mutant's tests, beyond which it counts as killed; an endless loop takes no less."""
MAX_SECONDS = 1200.0
"""Likewise, by the clock, for all tests at once."""
MIN_SECONDS, MAX_SLOWDOWN = 30.0, 4.0
"""By the clock, a mutant's tests may take so long, and so many times as long as without a change."""


@dataclass(frozen=True)
class Subject:
    """What is mutated, and the tests that must notice.

    Args:
        functions: module, relative to the root, -> names of its functions and classes; none means all.
        tests: arguments of pytest.
        shares_fixtures: whether fixtures of the session are set up once, such as a database server, and not
            for each mutant.
    """

    functions: dict[str, tuple[str, ...]]
    tests: tuple[str, ...]
    shares_fixtures: bool = False


SUBJECTS = {
    "resolver": Subject(
        {"engine/runs/config.py": (), "engine/settings/nested_options.py": ()},
        (
            "tests/test_configuration.py",
            "tests/cli/test_settings_resolution.py",
            "tests/test_renamed_settings.py",
        ),
    ),
    "fences": Subject(
        {
            "workers/queue/attempts.py": (
                "Attempt.heartbeat",
                "Attempt.read_state",
                "Attempt._fenced_transaction",
                "Attempt._check_fence",
                "claim",
            ),
            "workers/queue/recovery.py": (),
            "workers/queue/job_endings.py": ("recover_attempt",),
            "workers/queue/jobs.py": ("get_job",),
            "workers/queue/storage_leases.py": (
                "StorageLease",
                "storage_lease",
                "removal_transaction",
                "mark_for_removal",
                "unmark_for_removal",
                "expire_stale_leases",
                "_are_being_removed",
                "_removal_count",
            ),
        },
        (
            "tests/queue/test_claims_and_recoveries.py",
            "tests/queue/test_lease_fences.py",
            "tests/queue/test_queue_faults.py",
            "tests/queue/test_queue_jobs.py",
            "-k",
            "not later-tables",
        ),
        shares_fixtures=True,
    ),
    "reference": Subject(
        {"engine/trace/reference.py": ("trace_reference", "_colors", "_hit_count")},
        (
            "tests/trace/test_conformance.py",
            "tests/trace/test_closed_forms.py",
            "tests/trace/test_reference_comparison.py",
            "tests/trace/test_shared_sort.py",
            "-k",
            "not always",
        ),
    ),
}

_COMPARISONS: dict[type[ast.cmpop], type[ast.cmpop]] = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
}  # fmt: skip
_OPERATORS: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.FloorDiv: ast.Div,
    ast.Mod: ast.Mult, ast.Pow: ast.Mult, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd,
}  # fmt: skip
_SQL = re.compile(r"\b(SELECT|UPDATE|INSERT INTO|DELETE FROM)\b")
_SQL_CHANGES: tuple[tuple[str, str], ...] = (
    (r"(?<=[\w)]) AND (?!now|clock)", " OR "), (r" OR ", " AND "), (r"\bNOT (?=heartbeat)", ""),
    (r" <> ", " = "), (r" < ", " <= "), (r" > ", " < "), (r" \+ (?=\w)", " - "), (r" - (?=\w)", " + "),
    (r"FOR UPDATE( SKIP LOCKED)?", ""), (r" SKIP LOCKED", ""), (r"'(\w+)'", "'other'"), (r"\bmax\(", "min("),
    (r"\bmin\(", "max("), (r"DO NOTHING", "DO UPDATE SET sha256 = 'x'"),
    (r"(?<=WHERE )(?=\w)", "NOT "), (r"WHERE (?!.*WHERE)", "WHERE TRUE OR "),
)  # fmt: skip
Change = Callable[[], str]


@dataclass(frozen=True)
class Mutant:
    """One change of a module.

    Args:
        path: of the module, relative to the root.
        line: of the change.
        statement: first and last line of the statement it is in, without its body.
        text: what is changed to what.
        source: of the changed module.
    """

    path: str
    line: int
    statement: tuple[int, int]
    text: str
    source: str


def mutants_of(path: str, names: Sequence[str]) -> Iterator[Mutant]:
    """Yield the mutants of a module, or of what ``names`` lists of it."""
    source = (ROOT / path).read_text(encoding="utf-8")
    found = list(_changes(ast.parse(source), names))
    for index, (node, statement, _change) in enumerate(found):
        tree = ast.parse(source)
        _node, _statement, change = list(_changes(tree, names))[index]
        text = change()
        line = node.target.lineno if isinstance(node, ast.comprehension) else node.lineno
        yield Mutant(path, line, statement, text, ast.unparse(ast.fix_missing_locations(tree)))


def _changes(tree: ast.Module, names: Sequence[str]) -> Iterator[tuple[Any, tuple[int, int], Change]]:
    """Yield the nodes of a tree with the changes that can be made in place."""
    for top in tree.body:
        if not isinstance(top, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            continue  # constants are no logic
        if not names or top.name in names:
            yield from _changes_below(top, None)
        elif isinstance(top, ast.ClassDef):
            for method in top.body:
                if f"{top.name}.{getattr(method, 'name', None)}" in names:
                    yield from _changes_below(method, None)


def _changes_below(
    node: ast.AST, statement: tuple[int, int] | None, parent: Any = None
) -> Iterator[tuple[Any, tuple[int, int], Change]]:
    if isinstance(node, ast.ClassDef):
        for method in node.body:
            if isinstance(method, ast.FunctionDef | ast.AsyncFunctionDef):
                yield from _changes_below(method, None, node)
        return
    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
        statement = (node.body[0].lineno, node.end_lineno or node.lineno)
    elif isinstance(node, ast.stmt) and statement is not None:
        body = getattr(node, "body", None)
        statement = (node.lineno, body[0].lineno - 1 if body else node.end_lineno or node.lineno)
        statement = (statement[0], max(statement))
    assert statement is not None
    for change in _changes_of(node, parent):
        yield node, statement, change
    skipped = {"annotation", "returns", "decorator_list", "bases"}
    for name, value in ast.iter_fields(node):
        if name in skipped or isinstance(node, ast.JoinedStr):
            continue
        for child in value if isinstance(value, list) else [value]:
            is_docstring = isinstance(child, ast.Expr) and isinstance(child.value, ast.Constant)
            if isinstance(child, ast.AST) and not is_docstring:
                yield from _changes_below(child, statement, node)


def _changes_of(node: Any, parent: Any) -> Iterator[Change]:
    """Yield the changes of one node, children left out; each returns what it did."""

    def put(holder: Any, name: str, value: Any) -> Change:
        def change() -> str:
            before = ast.unparse(node.test if name == "test" else node)
            setattr(holder, name, value)
            after = ast.unparse(node.test if name == "test" else node)
            return f"{_short(before)} -> {_short(after)}"

        return change

    def become(new: Callable[[], ast.AST]) -> Change:
        def change() -> str:
            before, made = ast.unparse(node), ast.fix_missing_locations(ast.copy_location(new(), node))
            for name, value in ast.iter_fields(parent):
                if value is node:
                    setattr(parent, name, made)
                elif isinstance(value, list) and any(item is node for item in value):
                    setattr(parent, name, [made if item is node else item for item in value])
            return f"{_short(before)} -> {_short(ast.unparse(made))}"

        return change

    if isinstance(node, ast.Compare):
        for index, operator in enumerate(node.ops):
            if type(operator) in _COMPARISONS:
                ops = [*node.ops[:index], _COMPARISONS[type(operator)](), *node.ops[index + 1 :]]
                yield put(node, "ops", ops)
    elif isinstance(node, ast.BinOp | ast.AugAssign) and type(node.op) in _OPERATORS:
        yield put(node, "op", _OPERATORS[type(node.op)]())
    elif isinstance(node, ast.BoolOp):
        yield put(node, "op", ast.And() if isinstance(node.op, ast.Or) else ast.Or())
    elif isinstance(node, ast.UnaryOp):
        yield become(lambda: node.operand)
    elif isinstance(node, ast.Constant) and not isinstance(parent, ast.Subscript | ast.Expr):
        yield from (put(node, "value", value) for value in _other_values(node.value))
    elif isinstance(node, ast.Return) and node.value is not None:
        if not (isinstance(node.value, ast.Constant) and node.value.value is None):
            yield put(node, "value", ast.Constant(None))
    elif isinstance(node, ast.Expr | ast.Raise | ast.Break | ast.Continue):
        yield become(ast.Pass)
    if isinstance(node, ast.AugAssign):
        yield become(ast.Pass)
    if isinstance(node, ast.If | ast.IfExp):
        yield put(node, "test", ast.Constant(True))
        yield put(node, "test", ast.Constant(False))
    elif isinstance(node, ast.comprehension) and node.ifs:
        yield put(node, "ifs", [])
    elif isinstance(node, ast.Call):
        for index, keyword in enumerate(node.keywords):
            if keyword.arg is not None and keyword.arg != "description":
                yield put(node, "keywords", [*node.keywords[:index], *node.keywords[index + 1 :]])


def _other_values(value: object) -> Iterator[object]:
    if isinstance(value, bool):
        yield not value
    elif isinstance(value, int | float):
        yield value + 1
    elif isinstance(value, str) and _SQL.search(value):
        for pattern, other in _SQL_CHANGES:
            for match in re.finditer(pattern, value, re.DOTALL):
                yield value[: match.start()] + other + value[match.end() :]
        yield from _dropped_assignments(value)
    elif isinstance(value, str) and value and " " not in value:
        yield value + "X"


def _dropped_assignments(query: str) -> Iterator[str]:
    """Yield an UPDATE with each of its assignments left out, where it has several."""
    match = re.search(r"\bSET\b(.*?)(?=\bWHERE\b)", query, re.DOTALL)
    if not query.lstrip().startswith("UPDATE") or match is None:
        return
    parts = re.split(r",(?![^()]*\))", match[1])
    for index in range(len(parts) if len(parts) > 1 else 0):
        kept = ",".join(part for at, part in enumerate(parts) if at != index)
        yield f"{query[: match.start(1)]}{kept} {query[match.end(1) :]}"


def _short(text: str) -> str:
    return " ".join(text.split())


def _exchange_code(path: Path, source: str) -> None:
    """Give the functions of the imported module at ``path`` the code that ``source`` has for them."""
    module = _module_at(path)
    changed = type(module)(module.__name__)
    sys.modules["changed"] = changed
    assert module.__file__ is not None
    loader = importlib.machinery.SourceFileLoader(module.__name__, module.__file__)
    if module.__spec__ is not None and isinstance(
        module.__spec__.loader, importlib.machinery.SourceFileLoader
    ):
        loader = module.__spec__.loader
    exec(loader.source_to_code(source.encode(), module.__file__), changed.__dict__)
    for name, value in vars(changed).items():
        if getattr(value, "__module__", None) != module.__name__:
            continue
        before = getattr(module, name)
        if isinstance(value, type):
            for attribute, inner in vars(value).items():
                _exchange_function(vars(before).get(attribute), inner)
        else:
            _exchange_function(before, value)


def _exchange_function(before: Any, after: Any) -> None:
    """Give a function, or what is wrapped in it, the code and defaults of another one."""
    if hasattr(before, "cache_clear"):
        before.cache_clear()
    before, after = _innermost(before), _innermost(after)
    if isinstance(before, FunctionType) and isinstance(after, FunctionType):
        before.__code__ = after.__code__
        before.__defaults__, before.__kwdefaults__ = after.__defaults__, after.__kwdefaults__


def _clear_caches(path: Path) -> None:
    """Empty the caches of the functions of the imported module at ``path``."""
    for value in vars(_module_at(path)).values():
        if hasattr(value, "cache_clear"):
            value.cache_clear()


def _module_at(path: Path) -> Any:
    return sys.modules["octasplat." + ".".join(path.relative_to(ROOT).with_suffix("").parts)]


def _innermost(value: Any) -> Any:
    if isinstance(value, property):
        value = value.fget
    while hasattr(value, "__wrapped__") or hasattr(value, "wrapped"):  # by functools, by pydantic
        value = getattr(value, "__wrapped__", None) or value.wrapped
    return getattr(value, "__func__", value)


def _in_fork(work: Callable[[], object], max_seconds: float = MAX_SECONDS) -> Any:
    """Return what ``work`` returns in a fork, as JSON; None if it takes too long or dies."""
    with tempfile.TemporaryFile() as answer:
        child = os.fork()
        if child == 0:
            try:
                silent = os.open(os.devnull, os.O_WRONLY)
                os.dup2(silent, 1)
                os.dup2(silent, 2)
                resource.setrlimit(resource.RLIMIT_CPU, (MAX_CPU_SECONDS, MAX_CPU_SECONDS))
                answer.write(json.dumps(work()).encode())
                answer.flush()
            finally:
                os._exit(0)
        deadline = time.monotonic() + max_seconds
        while os.waitpid(child, os.WNOHANG) == (0, 0):
            if time.monotonic() > deadline:
                os.kill(child, signal.SIGKILL)
                os.waitpid(child, 0)
                return None
            time.sleep(0.02)
        answer.seek(0)
        text = answer.read()
        return json.loads(text) if text else None


class MutationRun:
    """A plugin of pytest whose loop runs all tests once, and then those of each mutant, each time in a fork.

    Args:
        subject: what is mutated.
        mutants: its mutants.
    """

    def __init__(self, subject: Subject, mutants: Sequence[Mutant]) -> None:
        self._subject = subject
        self._mutants = mutants
        self._has_failed = False

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Note a failure."""
        self._has_failed |= report.failed

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        """Run the tests and the mutants; print the survivors and the counts."""
        files = [ROOT / path for path in self._subject.functions]
        if self._subject.shares_fixtures:
            self._set_up_session(session.items)
        found = _in_fork(lambda: self._run_all(session.items, files))
        if found is None:
            sys.exit("The tests do not pass without a change.")
        reached, seconds = found
        items = {item.nodeid: item for item in session.items}
        print(f"{len(items)} tests, {sum(seconds.values()):.0f} s; {len(self._mutants)} mutants", flush=True)
        counts = {path: [0, 0] for path in self._subject.functions}
        for number, mutant in enumerate(self._mutants):
            print(f"{number} of {len(self._mutants)}", end="\r", file=sys.stderr)
            first, last = mutant.statement
            names = {
                name for line in range(first, last + 1) for name in reached[mutant.path].get(str(line), ())
            }
            tests = [items[name] for name in sorted(names - {""}, key=seconds.__getitem__)]

            def run(mutant: Mutant = mutant, tests: Sequence[pytest.Item] = tests) -> bool:
                _exchange_code(ROOT / mutant.path, mutant.source)
                return self._pass(tests)

            limit = MIN_SECONDS + MAX_SLOWDOWN * sum(seconds[test.nodeid] for test in tests)
            has_survived = not tests or _in_fork(run, limit) is True
            counts[mutant.path][has_survived] += 1
            if has_survived:
                reach = f"{len(tests)} tests" if tests else "no test reaches it"
                print(f"survived: {mutant.path}:{mutant.line}: {mutant.text} ({reach})", flush=True)
        for path, (killed, survived) in counts.items():
            print(f"{path}: {killed + survived} mutants, {killed} killed, {survived} survived")
        return True

    def _set_up_session(self, items: Sequence[pytest.Item]) -> None:
        """Run a test whose fixtures of the session stay for the forks: the next one is in another module."""
        item = items[0]
        after = next((other for other in items if other.path != item.path), items[-1])
        item.config.hook.pytest_runtest_protocol(item=item, nextitem=after)

    def _run_all(
        self, items: Sequence[pytest.Item], files: Sequence[Path]
    ) -> tuple[dict[str, dict[int, list[str]]], dict[str, float]]:
        """Run all tests; return the tests that reach each line of each file, and the tests' seconds."""
        for path in self._subject.functions:  # that alone must change nothing
            _exchange_code(ROOT / path, (ROOT / path).read_text(encoding="utf-8"))
        watch = coverage.Coverage(data_file=None, config_file=False, include=[str(file) for file in files])
        seconds = {}
        watch.start()
        for item, after in zip(items, self._following(items), strict=True):
            watch.switch_context(item.nodeid)
            for file in files:  # else a cached function is reached by the first test alone
                _clear_caches(file)
            begun = time.perf_counter()
            item.config.hook.pytest_runtest_protocol(item=item, nextitem=after)
            seconds[item.nodeid] = time.perf_counter() - begun
        watch.stop()
        if self._has_failed:
            raise AssertionError("a test has failed")
        data = watch.get_data()
        return {str(file.relative_to(ROOT)): data.contexts_by_lineno(str(file)) for file in files}, seconds

    def _following(self, items: Sequence[pytest.Item]) -> list[pytest.Item | None]:
        """Return the test after each; after the last one another, if fixtures of the session are to stay."""
        return [*items[1:], items[0] if self._subject.shares_fixtures else None]

    def _pass(self, items: Sequence[pytest.Item]) -> bool:
        """Return whether tests pass; ends at the first that does not."""
        for item, after in zip(items, self._following(items), strict=True):
            item.config.hook.pytest_runtest_protocol(item=item, nextitem=after)
            if self._has_failed:
                if not self._subject.shares_fixtures:
                    items[0].session._setupstate.teardown_exact(None)  # what fixtures started is stopped
                return False
        return True


def _is_in(mutant: Mutant, part: str) -> bool:
    """Return whether a mutant is in a part of a file, FILE:FIRST-LAST or FILE:LINE."""
    name, _, lines = part.partition(":")
    first, _, last = lines.partition("-")
    return mutant.path.endswith(f"/{name}") and int(first) <= mutant.line <= int(last or first)


def main() -> None:
    """Run the mutants of one subject and print the survivors."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("subject", choices=SUBJECTS)
    parser.add_argument("--list", action="store_true", help="print the mutants; run nothing")
    parser.add_argument(
        "--lines",
        nargs="+",
        metavar="FILE:FIRST-LAST",
        help="only these mutants; FILE by its last part",
    )
    arguments = parser.parse_args()
    subject = SUBJECTS[arguments.subject]
    mutants = [mutant for path, names in subject.functions.items() for mutant in mutants_of(path, names)]
    if arguments.lines:
        mutants = [mutant for mutant in mutants if any(_is_in(mutant, part) for part in arguments.lines)]
    if arguments.list:
        for mutant in mutants:
            print(f"{mutant.path}:{mutant.line}: {mutant.text}")
        return
    os.chdir(ROOT)
    sys.path.insert(0, str(ROOT))
    os.environ["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = "1"
    sys.exit(pytest.main([*PYTEST, *subject.tests], plugins=[MutationRun(subject, mutants)]))


if __name__ == "__main__":
    main()
