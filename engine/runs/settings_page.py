"""The page of the documentation that lists all settings, made from their catalog."""

from octasplat.engine.runs.settings_catalog import MATERIALS, Setting, all_settings, format_value
from octasplat.engine.settings.fields import SettingLevel

_INTRODUCTION = f"""# Settings

All settings of a reconstruction; this page is written by `octasplat config list --markdown`. \
`--set NAME=VALUE` sets one, values as JSON; `octasplat config explain NAME` explains one, and \
`octasplat config diff RUN` tells which ones a run had changed.

Defaults are those of the preset `standard`; other presets are named where they differ, \
`{MATERIALS}` where materials are learnt with them.
"""
_TITLES: tuple[tuple[SettingLevel, str], ...] = (
    ("basic", "Basic: what most people set"),
    ("advanced", "Advanced: for scenes with which the defaults have trouble"),
    ("experimental", "Experimental: off, or for comparisons with published methods"),
)
_HEAD = ("| Setting | Type | Unit | Default | What it does |", "|---|---|---|---|---|")


def settings_page() -> str:
    """Return ``docs/settings.md``: all settings by group, as Markdown."""
    lines = [_INTRODUCTION]
    for level, title in _TITLES:
        rows = (_setting_row(entry) for entry in all_settings() if entry.group == level)
        lines += [f"## {title}", "", *_HEAD]
        lines += ["| " + " | ".join(map(_escape_cell, row)) + " |" for row in rows]
        lines.append("")
    return "\n".join(lines[:-1]) + "\n"


def _setting_row(entry: Setting) -> tuple[str, ...]:
    kind = entry.type + (f", {entry.range}" if entry.range else "")
    return f"`{entry.name}`", kind, entry.unit, _defaults_text(entry), entry.description


def _defaults_text(entry: Setting) -> str:
    others: dict[str, list[str]] = {}
    for name, value in entry.exceptions.items():
        others.setdefault(format_value(value), []).append(name)
    rest = "; ".join(f"{', '.join(names)}: {value}" for value, names in others.items())
    return format_value(entry.default) + (f" ({rest})" if rest else "")


def _escape_cell(text: str) -> str:
    return text.replace("|", "\\|").replace("<", "&lt;")
