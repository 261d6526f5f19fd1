"""The verbs: each as a command, a kind of job, a request over HTTP and a call in Python."""

from dataclasses import dataclass
from importlib import import_module
from keyword import iskeyword
from typing import Any

from octasplat.engine.operations.base import Operation
from octasplat.engine.operations.registry import operations
from octasplat.workers.cli.main import has_command
from octasplat.workers.worker.job_kinds import job_kinds

_PAGE = """# Verbs

What octasplat does, in all the ways in which it can be asked for; this page is written by \
`octasplat verbs --markdown`. Options have the same names and meanings everywhere: \
`octasplat VERB --help`, `GET /v1/options/KIND` and the class of the request show them. \
`osp` is `import octasplat as osp`; what is not there is called as any operation: \
`from octasplat.engine.operations import crop` and `crop.run(crop.CropRequest(...))`.

| Verb | What it does | Command | Kind of job, and what it works on | HTTP | Python |
|---|---|---|---|---|---|
"""


@dataclass(frozen=True)
class Verb:
    """A verb, and how it is asked for.

    Attributes:
        name: the verb.
        title: what it does.
        command: the command; empty where there is none.
        job_kind: the kind of job; empty where there is none.
        works_on: what such a job works on.
        http: the request to the service; empty where there is no such job.
        python: the call.
    """

    name: str
    title: str
    command: str
    job_kind: str
    works_on: str
    http: str
    python: str


def verbs() -> tuple[Verb, ...]:
    """Return all verbs, in the order in which users meet them."""
    kinds = {kind.name: kind for kind in job_kinds()}
    found = []
    for entry in operations():
        kind = kinds.get(entry.name)
        found.append(
            Verb(
                name=entry.name,
                title=entry.title,
                command=_command_of_verb(entry.name),
                job_kind=kind.name if kind else "",
                works_on=kind.needs if kind else "",
                http=f'POST /v1/jobs {{"kind": "{kind.name}", ...}}' if kind else "",
                python=_python_call(entry),
            )
        )
    return tuple(found)


def verbs_page() -> str:
    """Return the content of ``docs/verbs.md``."""
    return _PAGE + "".join(f"| {' | '.join(_verb_row(verb))} |\n" for verb in verbs())


def _command_of_verb(name: str) -> str:
    """Return the command of a verb; ``stage-init`` is ``octasplat stage init``."""
    words = name.split("-")
    return f"octasplat {' '.join(words)}" if has_command(words[0]) else ""


def _python_call(entry: Operation[Any, Any]) -> str:
    # The public names alone are read: what they stand for lies above the commands.
    name = entry.name.replace("-", "_") + ("_" if iskeyword(entry.name) else "")
    if name in import_module("octasplat").__all__:
        return f"osp.{name}(...)"
    module = entry.request.__module__.rpartition(".")[2]
    return f"{module}.run({module}.{entry.request.__name__}(...))"


def _verb_row(verb: Verb) -> tuple[str, ...]:
    works_on = "files" if verb.works_on == "files" else f"a {verb.works_on}"
    job = f"`{verb.job_kind}`, on {works_on}" if verb.job_kind else ""
    code = (f"`{text}`" if text else "" for text in (verb.command, verb.http, verb.python))
    command, http, python = code
    return verb.name, verb.title, command, job, http, python
