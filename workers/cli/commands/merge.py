"""``octasplat merge``: several scenes as one."""

from pathlib import Path

import click

from octasplat.workers.cli.options import quiet_option


@click.command(short_help="Put scenes together.")
@click.argument("sources", metavar="IN...", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("-o", "--output", type=click.Path(path_type=Path), required=True, help="The scene to write.")
@click.option(
    "--sh-degree",
    type=click.IntRange(0, 3),
    help="Degree of the colours' harmonics.  [default: the highest among the scenes]",
)
@quiet_option
def merge(sources: tuple[Path, ...], output: Path, sh_degree: int | None, quiet: bool) -> None:
    """Put all Gaussians of two or more scenes into one file, each where it is in its own frame.

    Named channels that only some of the scenes have are 0 for the Gaussians of the others.
    """
    if len(sources) < 2:
        raise click.UsageError("Name at least two scenes.")

    from octasplat.engine.edit.selection import merge as merge_scenes
    from octasplat.engine.files import read_facts
    from octasplat.engine.gaussians.scene_facts import shared_facts
    from octasplat.workers.cli.editing import speaker, targets_for, write_scene
    from octasplat.workers.cli.scene_files import open_scene
    from octasplat.workers.cli.signals import orderly_termination

    (target,) = targets_for(output, [sources[0]], sources)
    with orderly_termination():
        scenes = [open_scene(source, quiet=quiet) for source in sources]
        every = dict.fromkeys(name for scene in scenes for name in scene.channels)
        for source, scene in zip(sources, scenes, strict=True):
            if missing := ", ".join(name for name in every if name not in scene.channels):
                click.echo(f"Warning: {source}: has no channel {missing}; it is 0 there.", err=True)
        facts = shared_facts(list(zip(scenes, map(read_facts, sources), strict=True)))
        write_scene(merge_scenes(scenes, sh_degree), facts, target, speaker(quiet))
