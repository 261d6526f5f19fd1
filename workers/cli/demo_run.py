"""Steps of ``octasplat demo``: the synthetic dataset and its reconstruction, each resumed by itself."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.core.progress import counted_phase
from octasplat.engine.dataset.synthetic import SyntheticDatasetConfig, write_synthetic_dataset
from octasplat.engine.operations.reconstruct import ReconstructRequest, finished_result
from octasplat.engine.runs.config import ReconstructionConfig, read_config
from octasplat.engine.runs.run_folder import CONFIG
from octasplat.engine.settings.preset_names import PresetName
from octasplat.workers.cli.printing import Printer
from octasplat.workers.cli.progress import show_progress
from octasplat.workers.cli.reconstruction import run_reconstruction
from octasplat.workers.cli.signals import exit_on_sigterm

DEMO_ASSIGNMENTS: dict[str, tuple[str, ...]] = {"fast": ("iterations=2000",)}
"""Training settings by preset, chosen so that the demo takes less than three minutes on two cores."""


def make_demo_scene(root: Path, settings: Mapping[str, int | str | None], *, quiet: bool) -> None:
    """Write the generated scene unless it is there.

    Args:
        root: folder of the scene.
        settings: fields of :class:`SyntheticDatasetConfig`; None values take the default.
        quiet: show no progress.

    Raises:
        OctasplatError: the folder holds something else or cannot be written, or a setting is out of range.
    """
    given: dict[str, Any] = {name: value for name, value in settings.items() if value is not None}
    config = SyntheticDatasetConfig(**given)
    if (root / "generated.json").exists():
        write_synthetic_dataset(root, config)  # only makes sure that it is the same
        return
    with (
        exit_on_sigterm(),
        show_progress(quiet=quiet) as listener,
        counted_phase("generate", listener, config.views) as progress,
    ):
        write_synthetic_dataset(root, config, progress)


def reconstruct_demo_scene(
    scene: Path, output: Path, preset: PresetName, printer: Printer, *, threads: int
) -> Path:
    """Reconstruct the demo scene, or go on with it, and return the path of the report.

    Raises:
        StoppedError: by a signal, after a checkpoint.
        OctasplatError: as :func:`octasplat.engine.pipeline.reconstruction` does.
    """
    resume = (output / CONFIG).exists()
    request = ReconstructRequest(
        source=scene,
        output=output,
        resume=resume,
        preset=preset,
        set=DEMO_ASSIGNMENTS.get(preset, ()),
    )
    config = request.config().with_poses_decided(has_model=True)
    if resume and read_config(output / CONFIG).with_poses_decided(has_model=True) != config:
        raise ConfigError(
            f"{output} holds a demo with other settings; delete it or name another folder with -o."
        )
    report = output / "report.html"
    if not (resume and is_complete(output, config)):
        run_reconstruction(request, printer, threads=threads, resumes_automatically=True)
    elif printer.as_json:
        printer.print(finished_result(output, config.exports), ())
    return report


def is_complete(output: Path, config: ReconstructionConfig) -> bool:
    """Return whether every file of the run is there."""
    names = ("scene.ply", "metrics.json", "report.html", *config.exports)
    return all((output / name).exists() for name in names)
