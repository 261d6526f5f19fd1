"""Steps after the training: evaluation, and export to other formats."""

from octasplat.engine.core.errors import CancelledError, ConfigError, ExportError
from octasplat.engine.core.events import PhaseProgress, Warned
from octasplat.engine.core.progress import phase
from octasplat.engine.evaluate.run_evaluation import measure_run
from octasplat.engine.files import ExportOptions, dropped_on_export, exporter_for, read_metadata
from octasplat.engine.files.export_batch import export_batch, targets_with_known_format
from octasplat.engine.files.gaussian_ply import read_gaussian_ply
from octasplat.engine.files.mesh_glb import VIEWER_FORMAT
from octasplat.engine.files.registry import Exporter
from octasplat.engine.files.surface_export import SURFACE_FORMATS
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.pipeline.run import ReconstructionRun
from octasplat.engine.runs.baked_scene import BakedScene
from octasplat.engine.runs.run_folder import METRICS, REPORT, SCENE, unexported_parts
from octasplat.engine.runs.small_surface import small_surface
from octasplat.engine.runs.viewer_glb import prepare_for_viewers, upright_turn

SURFACE_WORK, COLOR_WORK = 5.0, 4.0
"""Work of the textured surface, and of one color for each Gaussian, in files that are simply written."""


class EvaluateStep:
    """Measure the held-out views; files are exported even if that fails."""

    is_needed_later = False

    def is_done(self, run: ReconstructionRun) -> bool:
        """Return whether the measurements and the report exist."""
        return (run.output / METRICS).exists() and (run.output / REPORT).exists()

    def __call__(self, run: ReconstructionRun) -> None:
        """Evaluate the held-out views of the run."""
        with phase("evaluate", run.progress, len(run.dataset.test_indices)):
            measure_run(run.dataset, run.output, run.config, run.threads, run.progress)


class ExportStep:
    """Write the missing export files, as many as can be written."""

    is_needed_later = True

    def is_done(self, run: ReconstructionRun) -> bool:
        """Return False: the step is reported even if all files exist."""
        return False

    def __call__(self, run: ReconstructionRun) -> None:
        """Write the files.

        Raises:
            ExportError: some could not be written.
        """
        with phase("export", run.progress, len(run.config.exports)):
            # a resumed run writes only what is not there
            missing = [name for name in run.config.exports if not (run.output / name).exists()]
            failed = _export(run, missing) if missing else None
        if failed is not None:
            raise ExportError(f"{failed} Everything else is there.")


def _export(run: ReconstructionRun, names: list[str]) -> str | None:
    """Write files; return which could not be written, and why."""
    output, progress = run.output, run.progress
    gaussians, _ = read_gaussian_ply(output / SCENE, folder=output)
    if (left_out := unexported_parts(output)) is not None:
        progress(Warned(left_out))
    options = ExportOptions(q=run.config.train.trace.q, facts=read_metadata(output))

    formats = {name: exporter_for(output / name) for name in names}
    surfaces = [name for name, exporter in formats.items() if exporter.name in SURFACE_FORMATS]
    needs_colors = any(
        not exporter.holds_harmonics for name, exporter in formats.items() if name not in surfaces
    )
    surface_work, color_work = SURFACE_WORK * bool(surfaces), COLOR_WORK * needs_colors
    work, files_done, prepared = len(names) + surface_work + color_work, 0, 0.0

    def beat() -> None:
        if run.should_stop():
            raise CancelledError("Stopped while exporting; the same command with --resume goes on.")
        report(files_done)

    def report(done: int) -> None:
        nonlocal files_done
        files_done = done
        progress(PhaseProgress("export", done, len(names), work_done=(prepared + done) / work))

    def note_pass(done: int, total: int) -> None:
        nonlocal prepared
        prepared = surface_work + color_work * done / total
        beat()

    plain = BakedScene(
        gaussians,
        output,
        threads=run.threads,
        on_pass=note_pass,
        on_unknown=lambda text: progress(Warned(text)),
    )
    surface = None
    if surfaces:
        try:
            surface = small_surface(output, gaussians, threads=run.threads, scratch=output, on_pass=beat)
        except ConfigError as error:  # nothing opaque enough was seen, which is no failure of the run
            progress(Warned(f"{' and '.join(surfaces)} cannot be made: {error}"))
            names = [name for name in names if name not in surfaces]
        prepared = surface_work
    targets = [output / name for name in names]
    for lost in dropped_on_export(gaussians, targets_with_known_format(targets), facts=options.facts):
        progress(Warned(lost))

    def prepare(exporter: Exporter) -> tuple[FlatGaussians, ExportOptions]:
        if exporter.name in SURFACE_FORMATS:
            return gaussians, options.model_copy(
                update={"surface": lambda: surface, "turn_xyzw": upright_turn(output)}
            )
        scene = gaussians if exporter.holds_harmonics else plain.gaussians
        if exporter.name == VIEWER_FORMAT:
            return prepare_for_viewers(scene, output, options, "photographed")
        return scene, options

    _, failed = export_batch(
        targets,
        prepare,
        on_done=report,
    )
    return failed
