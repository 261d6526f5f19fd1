"""``octasplat config``: the settings of a reconstruction."""

import json
import textwrap
from dataclasses import asdict
from pathlib import Path
from typing import Any, get_args

import click

from octasplat.engine.settings.fields import SettingLevel

_json_option = click.option("--json", "as_json", is_flag=True, help="Write JSON.")


@click.group(short_help="The settings of a reconstruction: list, explain, compare.")
def config() -> None:
    """List and explain the settings of a reconstruction, and tell which ones a run had changed."""


@config.command("list", short_help="List the settings.")
@click.option("--all", "everything", is_flag=True, help="List all settings, not only the basic ones.")
@click.option("--group", type=click.Choice(get_args(SettingLevel)), help="List the settings of this group.")
@click.option("--markdown", is_flag=True, help="Write the page docs/settings.md.")
@_json_option
def list_settings(everything: bool, group: str | None, markdown: bool, as_json: bool) -> None:
    """List the settings, those that most people need unless asked for others."""
    from octasplat.engine.runs.settings_catalog import all_settings, format_value
    from octasplat.engine.runs.settings_page import settings_page

    if markdown:
        click.echo(settings_page(), nl=False)
        return
    listed_group = group or ("" if everything else "basic")
    entries = [entry for entry in all_settings() if not listed_group or entry.group == listed_group]
    if as_json:
        _write_json([_entry_as_dict(entry) for entry in entries])
        return
    width = max(len(entry.name) for entry in entries)
    for entry in entries:
        value = " ".join((format_value(entry.default), entry.unit)).strip()
        click.echo(f"{entry.name:{width}}  {value:<24}  {_first_sentence(entry.description)}")
    if len(entries) < len(all_settings()):
        click.echo(
            f"{len(entries)} of {len(all_settings())} settings; --all lists the others, too.", err=True
        )


@config.command(short_help="Explain a setting.")
@click.argument("name", metavar="NAME")
@_json_option
def explain(name: str, as_json: bool) -> None:
    """Explain the setting NAME, such as lr.mean: what it does, its unit, range and defaults."""
    from octasplat.engine.runs.settings_catalog import find_setting, format_value

    entry = find_setting(name)
    if as_json:
        _write_json(_entry_as_dict(entry))
        return
    click.echo(f"{entry.name} ({entry.group})")
    for line in textwrap.wrap(entry.description, 92):
        click.echo(f"  {line}")
    facts = {
        "Type": entry.type,
        "Unit": entry.unit,
        "Range": entry.range,
        "Default": format_value(entry.default),
        **{f"With {preset}": format_value(value) for preset, value in entry.exceptions.items()},
    }
    for label, text in facts.items():
        if text:
            click.echo(f"  {label}: {text}")


@config.command(short_help="Tell which settings a run had changed.")
@click.argument("run", metavar="RUN", type=click.Path(path_type=Path))
@click.argument("other", metavar="[RUN2]", required=False, type=click.Path(path_type=Path))
@_json_option
def diff(run: Path, other: Path | None, as_json: bool) -> None:
    """Tell in which settings RUN differs from the defaults of its preset, or RUN2 from RUN."""
    from octasplat.engine.runs.config import read_config
    from octasplat.engine.runs.run_folder import CONFIG
    from octasplat.engine.runs.settings_catalog import default_values, format_value, setting_differences

    first = read_config(run / CONFIG)
    before, after = (default_values(first), first) if other is None else (first, read_config(other / CONFIG))
    found = setting_differences(before, after)
    if as_json:
        _write_json([asdict(difference) for difference in found])
        return
    for difference in found:
        old, new = format_value(difference.before), format_value(difference.after)
        click.echo(f"{difference.name}: {old} -> {new}")
    if not found:
        what = f"the defaults of {first.preset}" if other is None else str(run)
        click.echo(f"No setting differs from {what}.")


def _entry_as_dict(entry: Any) -> dict[str, Any]:
    return {**asdict(entry), "default": entry.default}


def _first_sentence(text: str) -> str:
    return text.split(". ")[0].split("; ")[0].rstrip(".")


def _write_json(content: object) -> None:
    click.echo(json.dumps(content, indent=2))
