"""``octasplat demo``: the whole way on a scene that octasplat makes itself."""

from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import click
from pydantic import Field

from octasplat.engine.operations.base import Request
from octasplat.engine.settings import renamed_settings
from octasplat.engine.settings.fields import Output, Spelling, Unit
from octasplat.engine.settings.preset_names import PresetName
from octasplat.workers.cli.browser import has_display
from octasplat.workers.cli.options import threads_option
from octasplat.workers.cli.printing import Printer, output_options
from octasplat.workers.cli.request_options import request_from_options, request_options


class DemoRequest(Request):
    """Make photographs of a scene, reconstruct them and open the report; takes a few minutes.

    The same command goes on where it was interrupted.
    """

    former_names: ClassVar[renamed_settings.FormerNames] = renamed_settings.DEMO

    output: Output = Field(Path("octasplat-demo"), description="Folder for the scene and the result.")
    dataset_only: bool = Field(
        False, description="Only write the photographs and their poses, right into the output folder."
    )
    preset: PresetName = Field("fast", description="Settings of the reconstruction.")
    scene: Literal["still_life", "street"] = Field(
        "still_life",
        description="What is photographed: a still life on a table, or a street of 112 m for many views.",
    )
    views: Annotated[int | None, Spelling(metavar="N")] = Field(
        None, description="Number of photographs.  [default: 40]"
    )
    width_px: Annotated[int | None, Unit("px"), Spelling(("--width",), metavar="PX")] = Field(
        None, description="Width of the photographs.  [default: 320]"
    )
    height_px: Annotated[int | None, Unit("px"), Spelling(("--height",), metavar="PX")] = Field(
        None, description="Height of the photographs.  [default: 240]"
    )


@click.command(short_help="Try everything on a generated scene.", help=DemoRequest.__doc__)
@request_options(DemoRequest)
@click.option(
    "--open/--no-open", "open_report", default=None, help="Open the report in a browser at the end."
)
@threads_option
@output_options
def demo(open_report: bool | None, threads: int, printer: Printer, **given: Any) -> None:
    """Make a scene and reconstruct it; the text of the request is the help."""
    from octasplat.workers.cli.demo_run import make_demo_scene, reconstruct_demo_scene

    request: DemoRequest = request_from_options(DemoRequest, given)
    output = request.output
    given_scene = request.model_dump(include={"scene", "views", "width_px", "height_px"})
    if request.dataset_only:
        make_demo_scene(output, given_scene, quiet=printer.hides_progress)
        how = f"octasplat reconstruct {output} -o OUT"
        printer.print({"dataset": output}, [f"The dataset is in {output}; reconstruct it with: {how}"])
        return
    make_demo_scene(output / "scene", given_scene, quiet=printer.hides_progress)
    report = reconstruct_demo_scene(
        output / "scene", output / "result", request.preset, printer, threads=threads
    )
    printer.note(f"Open {report} in a browser to see the result.")
    if has_display() if open_report is None else open_report:
        import webbrowser

        webbrowser.open(report.resolve().as_uri())
