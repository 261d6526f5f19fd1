"""``octasplat config``: the settings of a reconstruction."""

import textwrap
from dataclasses import asdict
from pathlib import Path
from typing import Any, get_args

import click

from octasplat.engine.settings.fields import SettingLevel
from octasplat.workers.cli.printing import Printer, output_options, table_lines


@click.group(short_help="The settings of a reconstruction: list, explain, compare.")
def config() -> None:
    """List and explain the settings of a reconstruction, and tell which ones a run had changed."""


@config.command("list", short_help="List the settings.")
@click.option("--all", "everything", is_flag=True, help="List all settings, not only the basic ones.")
@click.option("--group", type=click.Choice(get_args(SettingLevel)), help="List the settings of this group.")
@click.option("--markdown", is_flag=True, help="Write the page docs/settings.md.")
@output_options
def list_settings(everything: bool, group: str | None, markdown: bool, printer: Printer) -> None:
    """List the settings, those that most people need unless asked for others."""
    from octasplat.engine.runs.settings_catalog import all_settings, format_value
    from octasplat.engine.runs.settings_page import settings_page

    if markdown:
        click.echo(settings_page(), nl=False)
        return
    listed_group = group or ("" if everything else "basic")
    entries = [entry for entry in all_settings() if not listed_group or entry.group == listed_group]
    printer.print(
        [_entry_as_dict(entry) for entry in entries],
        table_lines(
            ("Setting", "Default", "Meaning"),
            [
                (
                    entry.name,
                    f"{format_value(entry.default)} {entry.unit}".strip(),
                    _first_sentence(entry.description),
                )
                for entry in entries
            ],
        ),
        quiet_lines=[entry.name for entry in entries],
    )
    if len(entries) < len(all_settings()) and not printer.hides_progress:
        click.echo(
            f"{len(entries)} of {len(all_settings())} settings; --all lists the others, too.", err=True
        )


@config.command(short_help="Explain a setting.")
@click.argument("name", metavar="NAME")
@output_options
def explain(name: str, printer: Printer) -> None:
    """Explain the setting NAME, such as lr.mean: what it does, its unit, range and defaults."""
    from octasplat.engine.runs.settings_catalog import find_setting, format_value

    entry = find_setting(name)
    lines = [f"{entry.name} ({entry.group})"]
    lines += [f"  {line}" for line in textwrap.wrap(entry.description, 92)]
    facts = {
        "Type": entry.type,
        "Unit": entry.unit,
        "Range": entry.range,
        "Default": format_value(entry.default),
        **{f"With {preset}": format_value(value) for preset, value in entry.exceptions.items()},
    }
    lines += [f"  {label}: {text}" for label, text in facts.items() if text]
    printer.print(_entry_as_dict(entry), lines, quiet_lines=[format_value(entry.default)])


@config.command(short_help="Tell which settings a run had changed.")
@click.argument("run", metavar="RUN", type=click.Path(path_type=Path))
@click.argument("other", metavar="[RUN2]", required=False, type=click.Path(path_type=Path))
@output_options
def diff(run: Path, other: Path | None, printer: Printer) -> None:
    """Tell in which settings RUN differs from the defaults of its preset, or RUN2 from RUN."""
    from octasplat.engine.runs.config import read_config
    from octasplat.engine.runs.run_folder import CONFIG
    from octasplat.engine.runs.settings_catalog import default_values, format_value, setting_differences

    first = read_config(run / CONFIG)
    before, after = (default_values(first), first) if other is None else (first, read_config(other / CONFIG))
    found = setting_differences(before, after)
    what = f"the defaults of {first.preset}" if other is None else str(run)
    lines = [f"{item.name}: {format_value(item.before)} -> {format_value(item.after)}" for item in found]
    printer.print(
        found, lines or [f"No setting differs from {what}."], quiet_lines=[item.name for item in found]
    )


def _entry_as_dict(entry: Any) -> dict[str, Any]:
    return {**asdict(entry), "default": entry.default}


def _first_sentence(text: str) -> str:
    return text.split(". ")[0].split("; ")[0].rstrip(".")
