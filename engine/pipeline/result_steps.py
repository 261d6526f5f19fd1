"""Steps after the training: evaluation, and export to other formats."""

from octasplat.engine.core.errors import ExportError
from octasplat.engine.core.events import PhaseProgress, Warned
from octasplat.engine.core.progress import phase
from octasplat.engine.evaluate.run_evaluation import measure_run
from octasplat.engine.files import ExportOptions, dropped_on_export, read_metadata
from octasplat.engine.files.export_batch import export_batch, targets_with_known_format
from octasplat.engine.files.gaussian_ply import read_gaussian_ply
from octasplat.engine.pipeline.run import ReconstructionRun
from octasplat.engine.runs.baked_scene import BakedScene
from octasplat.engine.runs.run_folder import METRICS, REPORT, SCENE, unexported_parts


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
            missing = [name for name in run.config.exports if not (run.output / name).exists()]
            failed = _export(run, missing) if missing else None
        if failed is not None:
            raise ExportError(f"{failed} Everything else is there.")


def _export(run: ReconstructionRun, names: list[str]) -> str | None:
    """Write files; return which could not be written, and why."""
    output, progress = run.output, run.progress
    gaussians, _ = read_gaussian_ply(output / SCENE)
    if (left_out := unexported_parts(output)) is not None:
        progress(Warned(left_out))
    options = ExportOptions(q=run.config.train.trace.q, facts=read_metadata(output))
    plain = BakedScene(
        gaussians,
        output,
        threads=run.threads,
        on_pass=lambda _done, _total: progress(PhaseProgress("export", 0, len(names))),
        on_unknown=lambda text: progress(Warned(text)),
    )
    targets = [output / name for name in names]
    for lost in dropped_on_export(gaussians, targets_with_known_format(targets), facts=options.facts):
        progress(Warned(lost))
    _, failed = export_batch(
        targets,
        lambda exporter: (gaussians if exporter.holds_harmonics else plain.gaussians, options),
        on_done=lambda done: progress(PhaseProgress("export", done, len(names))),
    )
    return failed
