"""Formatting of figures and results for display."""

from octasplat.engine.core.events import HeldOutMeasured, TrainingProgress


def format_rate(per_second: float) -> str:
    """Return a rate with its thousands shortened: ``870``, ``310k``, ``1.25M``."""
    # From here on thousands would be rounded to 1000k.
    if per_second >= 999_500:
        return f"{per_second / 1e6:.2f}M"
    return f"{per_second / 1e3:.0f}k" if per_second >= 1000 else f"{per_second:.0f}"


def format_training_state(event: TrainingProgress, held_out: HeldOutMeasured | None) -> str:
    """Return the state of the training, without its iterations and the time left."""
    parts = [f"training {event.psnr:.1f} dB"]
    # What was measured before the training says nothing of it, and short ones measure once more at their end.
    if held_out is not None and (held_out.iteration > 0 or event.iteration == 0):
        parts.append(f"held out {held_out.psnr:.1f} dB")
    parts += [f"{event.gaussians:,} Gaussians", f"{format_rate(event.rays_per_second)} rays/s"]
    return ", ".join(parts)
