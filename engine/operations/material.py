"""``material``: change the materials of selected Gaussians."""

from collections.abc import Callable
from typing import Annotated, ClassVar

from pydantic import Field

from octasplat.engine.core.events import EventListener, ignore_events
from octasplat.engine.edit.edit_options import MaterialChange, Selection
from octasplat.engine.operations.base import (
    Operation,
    Options,
    SceneRequest,
    ScenesWritten,
    never_stop,
    options_of,
    stop_if,
)
from octasplat.engine.settings import renamed_settings
from octasplat.engine.settings.fields import InputFile, Output, Spelling


class MaterialOptions(Selection, MaterialChange, Options):
    """Options of how materials change, and of which Gaussians: those for which all given conditions hold."""

    former_names: ClassVar[renamed_settings.FormerNames] = renamed_settings.MATERIAL

    mesh: Annotated[InputFile | None, Spelling(metavar="MESH")] = Field(
        None,
        exclude_if=lambda mesh: mesh is None,
        description="Those whose octagons are in this mesh: IN's octagons.ply after the rest was "
        "deleted in an editor.",
    )
    masks: Annotated[tuple[InputFile, ...], Spelling(("--mask",), metavar="IMAGE")] = Field(
        (),
        max_length=1000,
        exclude_if=lambda masks: not masks,
        description="Those that show where this image is white; it has the name of one of the run's "
        "photographs. Several say together what is meant.",
    )


class MaterialRequest(MaterialOptions, SceneRequest):
    """Change the materials of IN, the folder of a run with materials or a file of Gaussians that has them.

    Without a choice all Gaussians are changed; of several choices all must hold. For example:
    octasplat material OUT --set roughness=0.3 --where "metallic > 0.5" -o OUT2
    """

    output: Output = Field(
        description="A folder for all of the run with its new scene, or a file for the scene alone."
    )


class MaterialResult(ScenesWritten):
    """The scene with changed materials.

    Attributes:
        changed: number of Gaussians that were changed.
        count: number of all Gaussians.
    """

    changed: int
    count: int


def run(
    request: MaterialRequest,
    *,
    progress: EventListener = ignore_events,
    should_stop: Callable[[], bool] = never_stop,
    threads: int = 0,
) -> MaterialResult:
    """Change the materials of a scene; see :class:`octasplat.engine.operations.base.Run`.

    Raises:
        ConfigError: the scene has no materials, or nothing is chosen.
        OutputError: the folder is taken or cannot be written.
        SceneFileError: the scene or the mesh cannot be read, or the scene not be written.
    """
    from octasplat.engine.edit.mask_selection import select_by_masks
    from octasplat.engine.edit.material_run import change_materials, has_known_light
    from octasplat.engine.edit.selection import in_mesh, selection_mask
    from octasplat.engine.files import read_mesh, read_metadata
    from octasplat.engine.gaussians.materials import require_materials
    from octasplat.engine.operations.scene_io import (
        check_edited_output,
        describe_edit,
        open_scene,
        write_edited_scene,
    )
    from octasplat.engine.runs.run_folder import SCENE, is_run

    source, output = request.source, request.output
    check_edited_output("material", request, output, [request.mesh, *request.masks])
    gaussians, origin = open_scene(source, progress), read_metadata(source).origin_world
    require_materials(gaussians, source / SCENE if is_run(source) else source)
    # the choice is inverted below, once mesh and masks have their part in it
    chosen = selection_mask(gaussians, request.model_copy(update={"inverse": False}), origin)
    if request.mesh is not None:
        chosen &= in_mesh(gaussians, read_mesh(request.mesh).about(origin), request.mesh)
    if request.masks:
        chosen &= select_by_masks(source, gaussians, request.masks, threads=threads)
    if request.inverse:
        chosen = ~chosen
    changed = change_materials(source, gaussians, chosen, request)
    count = int(chosen.sum())
    notes = [f"{source}: {count:,} of {len(chosen):,} Gaussians changed."]
    if not has_known_light(source):
        notes.append(
            "Viewers show their harmonics, which are as before; octasplat relight shows the materials."
        )
    record = describe_edit("material", options_of(MaterialOptions, request), gaussians=count)
    stop_if(should_stop)
    written = write_edited_scene(source, changed, output, progress, edit_record=record)
    return MaterialResult(
        files=written.files,
        folder=written.folder,
        notes=(*notes, written.sentence),
        changed=count,
        count=len(chosen),
    )


OPERATION = Operation("material", "Change the materials of a scene.", MaterialRequest, MaterialOptions, run)
