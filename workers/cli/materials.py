"""What ``octasplat material`` does once its options are understood."""

from collections.abc import Sequence
from typing import Any

from pydantic import ValidationError

from octasplat.engine.edit.choices import MaterialChange, Selection
from octasplat.engine.edit.masked import under_masks
from octasplat.engine.edit.material_run import (
    change_materials,
    check_new_run,
    edit_note,
    follows,
    write_changed_run,
)
from octasplat.engine.edit.selection import chosen_by, in_mesh
from octasplat.engine.errors import ConfigError
from octasplat.engine.files import read_facts, read_mesh
from octasplat.engine.gaussians.materials import MATERIAL_WIDTHS, require_materials
from octasplat.engine.run_folder import SCENE, is_run
from octasplat.workers.cli.editing import checked_options, speaker, targets_for, write_scene
from octasplat.workers.cli.scene_files import open_scene


def run_material(options: dict[str, Any]) -> None:
    """Change the materials of a scene as the options of the command say, and write it.

    Raises:
        OctasplatError: something cannot be read or written, names what is not there, or chooses nothing.
    """
    source, output = options["source"], options["output"]
    change = _change(options["values"], options["factors"])
    given = {name: options[name] for name in ("where", "box", "sphere", "inverse")}
    selection: Selection = checked_options(Selection, given)
    to_folder = is_run(source) and not output.suffix
    if to_folder:
        check_new_run(output)
    else:
        (output,) = targets_for(output, [source], [source])
    gaussians = open_scene(source, quiet=options["quiet"])
    require_materials(gaussians, source / SCENE if is_run(source) else source)
    chosen = chosen_by(gaussians, selection.model_copy(update={"inverse": False}))
    if options["mesh"] is not None:
        chosen &= in_mesh(gaussians, read_mesh(options["mesh"]), options["mesh"])
    if options["masks"]:
        chosen &= under_masks(source, gaussians, options["masks"])
    if selection.inverse:
        chosen = ~chosen
    changed = change_materials(source, gaussians, chosen, change)
    say = speaker(options["quiet"])
    say(f"{source}: {int(chosen.sum()):,} of {len(chosen):,} Gaussians changed.")
    if not follows(source):
        say("Viewers and octasplat render show their harmonics, which are as before; relight shows it.")
    if not to_folder:
        write_scene(changed, read_facts(source), output, say)
        return
    mesh = {"mesh": options["mesh"].name} if options["mesh"] is not None else {}
    masks = {"masks": [path.name for path in options["masks"]]} if options["masks"] else {}
    note = edit_note(change, selection, chosen) | mesh | masks
    write_changed_run(source, changed, output, note)
    say(f"Wrote {output}.")


def _change(values: Sequence[str], factors: Sequence[str]) -> MaterialChange:
    """The change that ``--set`` and ``--scale`` ask for.

    Raises:
        ConfigError: they cannot be read.
    """
    parts = {"set": _assigned("--set", values), "scale": _assigned("--scale", factors)}
    if not values and not factors:
        raise ConfigError("Say what to change, as in: --set roughness=0.3.")
    try:
        return MaterialChange.model_validate(parts)
    except ValidationError as error:
        first = error.errors()[0]
        place = " ".join(str(part) for part in first["loc"][:2])
        said = first["msg"].removeprefix("Value error, ")
        if first["type"] == "extra_forbidden":
            said = f"there is no such material; choose {', '.join(MATERIAL_WIDTHS)}"
        raise ConfigError(f"{f'--{place}: ' if place else ''}{said}.") from None


def _assigned(option: str, assignments: Sequence[str]) -> dict[str, str]:
    found: dict[str, str] = {}
    for assignment in assignments:
        name, equals, text = assignment.partition("=")
        if not equals:
            raise ConfigError(f"{option} {assignment}: write it as NAME=VALUE, as in: roughness=0.3.")
        found[name.strip()] = text.strip()
    return found
