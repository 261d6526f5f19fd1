"""The pages of docs/ that are made from the code: commands, HTTP, settings and the table of estimates.

    python -m benchmarks.reference            # name the pages that are not up to date, with status 1
    python -m benchmarks.reference --write    # write them

``docs/verbs.md`` and ``docs/settings.md`` are the pages of ``octasplat verbs`` and ``octasplat config list``.
"""

import argparse
import re
import sys
from collections.abc import Callable, Iterator, Mapping
from itertools import cycle
from pathlib import Path
from typing import Any

import click

from benchmarks.marked_parts import with_part
from octasplat.__main__ import cli
from octasplat.engine.dataset.image_sizes import ImageSizes
from octasplat.engine.operations.cost_model import estimate_reconstruction
from octasplat.engine.operations.reconstruct import ReconstructOptions
from octasplat.engine.runs.settings_page import settings_page
from octasplat.service.app import create_app
from octasplat.service.settings import ServiceSettings
from octasplat.service.web.api_page import ApiOperation, operation_groups
from octasplat.workers.cli.verbs import verbs_page
from octasplat.workers.settings import PREFIX, WorkerSettings

DOCS = Path(__file__).resolve().parents[1] / "docs"
WRITTEN_BY = "This page is written by `python -m benchmarks.reference --write`."
ESTIMATES_PAGE = "time_and_memory.md"
MEGAPIXELS = ((1_600, 1_200), (4_000, 3_000), (6_000, 4_000))
COUNTS = (20, 50, 100, 200, 500)
PRESETS = ("fast", "standard", "high")
CORES = (2, 8)
EVERYWHERE = frozenset({"400", "401", "403", "421", "422", "429", "503"})
"""Answers that any request may get; they are told once."""


def commands_page() -> str:
    """Return ``docs/commands.md``: each command with its options."""
    lines = [
        "# Commands",
        "",
        f"{WRITTEN_BY} `octasplat COMMAND --help` shows the same in the terminal. Every command ends with "
        "status 0 where it did what was asked, 1 with one sentence where it could not or cannot use a "
        "value, 2 where options are unknown, missing, out of range or do not go together, 130 or 143 where "
        "Ctrl-C or SIGTERM stopped it before its end, and 70 where something went wrong that nobody "
        "expected.",
        "",
    ]
    for context in _commands(click.Context(cli, info_name="octasplat")):
        command = context.command
        usage = context.get_usage().removeprefix("Usage: ")
        lines += [f"## {context.command_path}", "", "```text", " ".join(usage.split()), "```", ""]
        lines += [*_paragraphs(command.help or ""), ""]
        records = [
            parameter.get_help_record(context)
            for parameter in command.get_params(context)
            if "--help" not in parameter.opts
        ]
        if any(record and record[1] for record in records):
            lines += ["| Option | What it does |", "|---|---|"]
            rows = (record for record in records if record and record[1])
            lines += [f"| `{_code(record[0])}` | {_cell(record[1])} |" for record in rows]
            lines.append("")
    return "\n".join(lines[:-1]) + "\n"


def http_page() -> str:
    """Return ``docs/http.md``: each request with its parameters, fields and answers."""
    document = create_app(ServiceSettings()).openapi()
    lines = [
        "# HTTP requests",
        "",
        f"{WRITTEN_BY} A service shows the same at `/docs` and as OpenAPI 3.1 at `/openapi.json`. "
        "[HTTP by example](service.md) has examples.",
        "",
        "A GET and `POST /v1/estimates` need a token with the scope `read`, every other request one with "
        "`write`, unless its text says otherwise ([rights of tokens](service.md#rights-of-tokens)); "
        "`/healthz` and `/readyz` need none.",
        "",
        "Every request may also be answered by 400 (malformed), 401 (no valid token), 403 (the token's scope "
        "does not suffice), 421 (a foreign host name), 422 (refused, with the reasons under `errors`), "
        "429 (too many requests, or wrong tokens) or 503 (try again later), and one with a body by 413 (too "
        "long).",
        "",
    ]
    for group in operation_groups(document):
        lines += [f"## {group.name.capitalize()}", ""]
        for operation in group.operations:
            lines += [f"### {operation.method} {operation.path}", "", *_paragraphs(operation.text), ""]
            lines += _request_rows(document, operation)
            answers = (entry for entry in operation.answers if entry[0] not in EVERYWHERE)
            told = "; ".join(f"{status} {_cell(text)}".strip().rstrip(".") for status, text in answers)
            lines += [f"Answers: {told}.", ""]
    return "\n".join(lines[:-1]) + "\n"


def service_settings_page() -> str:
    """Return ``docs/service_settings.md``: each environment variable of the service."""
    lines = [
        "# Settings of the service",
        "",
        f"{WRITTEN_BY} Each setting is an environment variable of `octasplat serve`, `api` and `worker`.",
        "",
    ]
    for title, kind, before in (
        ("All programs of the service", WorkerSettings, None),
        ("The front end", ServiceSettings, WorkerSettings),
    ):
        meanings = _attributes(kind.__doc__ or "")
        lines += [f"## {title}", "", "| Variable | Default | What it does |", "|---|---|---|"]
        for name, field in kind.model_fields.items():
            if before is None or name not in before.model_fields:
                default = "" if field.default_factory else _default(field.default)
                lines.append(f"| `{PREFIX}{name.upper()}` | {default} | {_cell(meanings.get(name, ''))} |")
        lines.append("")
    return "\n".join(lines[:-1]) + "\n"


def estimates_page() -> str:
    """Return ``docs/time_and_memory.md`` with its table made anew."""
    text = (DOCS / ESTIMATES_PAGE).read_text(encoding="utf-8")
    program = "benchmarks.reference --write"
    return with_part(text, "estimates", program, estimates_table(), page=f"docs/{ESTIMATES_PAGE}")


def estimates_table() -> str:
    """Return the estimates of some numbers and sizes of photographs, as a table."""
    times = [f"{preset}, {cores} cores" for preset in PRESETS for cores in CORES]
    lines = [
        f"| Photographs | {' | '.join(times)} | memory, {PRESETS[1]} | disk, {PRESETS[1]} |",
        "|---" * (len(times) + 3) + "|",
    ]
    for width_px, height_px in MEGAPIXELS:
        for count in COUNTS:
            sizes = [ImageSizes(width_px, height_px, count)]
            found = {
                (preset, cores): estimate_reconstruction(
                    ReconstructOptions(preset=preset).config(), sizes, cores
                )
                for preset in PRESETS
                for cores in CORES
            }
            row = [f"{count} of {width_px * height_px / 1e6:.0f} MP"]
            row += [_rounded_time(entry.seconds) for entry in found.values()]
            standard = found[PRESETS[1], CORES[0]]
            row += [f"{standard.memory_bytes / 1e9:.1f} GB", f"{standard.disk_bytes / 1e9:.1f} GB"]
            lines.append(f"| {' | '.join(row)} |")
    return "\n".join(lines)


PAGES: Mapping[str, Callable[[], str]] = {
    "commands.md": commands_page,
    "http.md": http_page,
    "service_settings.md": service_settings_page,
    "settings.md": settings_page,
    "verbs.md": verbs_page,
    ESTIMATES_PAGE: estimates_page,
}


def _commands(context: click.Context) -> Iterator[click.Context]:
    """Yield the contexts of all commands below one."""
    group = context.command
    assert isinstance(group, click.Group)
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        assert command is not None
        inner = click.Context(command, info_name=name, parent=context, terminal_width=10_000)
        if isinstance(command, click.Group):
            yield from _commands(inner)
        elif not command.hidden:
            yield inner


def _request_rows(document: Mapping[str, Any], operation: ApiOperation) -> list[str]:
    """Return the table of what a request takes; empty where it takes nothing."""
    rows = [
        f"| `{entry.name}` | {entry.place} | {_cell(entry.kind)} | {_cell(entry.text)} |"
        for entry in operation.parameters
    ]
    body = (
        document["paths"][operation.path][operation.method.lower()].get("requestBody", {}).get("content", {})
    )
    for media_type, content in body.items():
        schemas = list(_objects(document, content.get("schema", {})))
        if not schemas:
            rows.append(f"| | body | `{media_type}` | |")
        told: dict[tuple[str, str, str], list[str]] = {}
        for title, schema in schemas:
            for name, field in schema.get("properties", {}).items():
                needed = ", needed" if name in schema.get("required", ()) else ""
                kind = _cell(_type(document, field)) + needed
                told.setdefault((name, kind, _cell(field.get("description", ""))), []).append(title)
        # What all choices have is told once, before what they differ in.
        for (name, kind, text), titles in sorted(
            told.items(), key=lambda entry: len(entry[1]) < len(schemas)
        ):
            where = "body" if len(titles) == len(schemas) else f"body of {', '.join(titles)}"
            rows.append(f"| `{name}` | {where} | {kind} | {text} |")
    return ["| Name | Where | Type | What it is |", "|---|---|---|---|", *rows, ""] if rows else []


def _objects(
    document: Mapping[str, Any], schema: Mapping[str, Any]
) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Yield the objects that a schema allows, with their titles."""
    schema = _resolved(document, schema)
    choices = schema.get("oneOf") or schema.get("anyOf") or []
    for choice in choices:
        yield from _objects(document, choice)
    if "properties" in schema:
        yield schema.get("title", ""), schema


def _resolved(document: Mapping[str, Any], schema: Mapping[str, Any]) -> Mapping[str, Any]:
    reference = schema.get("$ref")
    return document["components"]["schemas"][reference.rpartition("/")[2]] if reference else schema


def _type(document: Mapping[str, Any], schema: Mapping[str, Any]) -> str:
    """Return the type of a field in a few words."""
    if "$ref" in schema:
        resolved = _resolved(document, schema)
        return _type(document, resolved) if "enum" in resolved else f"`{resolved.get('title', 'object')}`"
    if choices := schema.get("anyOf") or schema.get("oneOf"):
        return " or ".join(dict.fromkeys(_type(document, choice) for choice in choices))
    if "const" in schema:
        return f"`{schema['const']}`"
    if "enum" in schema:
        return " or ".join(f"`{value}`" for value in schema["enum"])
    if schema.get("type") == "array":
        return f"list of {_type(document, schema.get('items', {}))}"
    return str(schema.get("format") or schema.get("type", "any"))


def _attributes(docstring: str) -> dict[str, str]:
    """Return the text of each attribute in a docstring of Google's style."""
    _, _, part = docstring.partition("Attributes:\n")
    found = re.findall(r"^        (\w+): (.*?)(?=^        \w+: |\Z)", part, re.MULTILINE | re.DOTALL)
    return {name: " ".join(text.replace("``", "`").split()) for name, text in found}


def _default(value: object) -> str:
    if value is None or value == () or value == "":
        return "none"
    return f"`{str(value).lower() if isinstance(value, bool) else value}`"


def _rounded_time(seconds: float) -> str:
    """Return a duration in whole minutes, or in halves of an hour where it is long."""
    if seconds < 3_600:
        return f"{max(1, round(seconds / 60))} min"
    return f"{round(seconds / 1_800) / 2:g} h"


def _paragraphs(text: str) -> list[str]:
    """Return a help text with one line for each paragraph."""
    clean = re.sub(r"[\b\f]", "", text).strip()
    joined = [" ".join(part.split()) for part in clean.split("\n\n")]
    return "\n\n".join(joined).replace("<", "&lt;").replace("*.", "\\*.").splitlines()


def _code(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")


def _cell(text: str) -> str:
    """Return a text for a cell of a table; what is code already shows ``<`` as it is."""
    parts = " ".join(text.split()).replace("|", "\\|").split("`")
    return "`".join(part if odd else part.replace("<", "&lt;") for part, odd in zip(parts, cycle((0, 1))))


def stale_pages() -> list[str]:
    """Return the names of the pages that are not what the code makes today."""
    return [
        name
        for name, make in PAGES.items()
        if not (DOCS / name).is_file() or (DOCS / name).read_text(encoding="utf-8") != make()
    ]


def main() -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--write", action="store_true", help="write the pages")
    stale = stale_pages() if not parser.parse_args().write else []
    if stale:
        print(f"Not up to date: {', '.join(stale)}; run python -m benchmarks.reference --write.")
        return 1
    if "--write" in sys.argv:
        for name, make in PAGES.items():
            (DOCS / name).write_text(make(), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
