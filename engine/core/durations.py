"""Durations as text."""


def format_clock(seconds: float) -> str:
    """Return a duration as ``1:23`` or ``1:02:03``.

    >>> format_clock(83), format_clock(3723)
    ('1:23', '1:02:03')
    """
    minutes, rest = divmod(max(0, round(seconds)), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"


def format_duration(seconds: float) -> str:
    """Return a duration in words: ``0.8 s``, ``42 s``, ``3:05 min``, ``1:02:03 h``.

    >>> format_duration(0.8), format_duration(185), format_duration(3723)
    ('0.8 s', '3:05 min', '1:02:03 h')
    """
    # Limits at which rounding would give the next form: 9.95 s would be shown as 10.0 s.
    if seconds < 9.95:
        return f"{seconds:.1f} s"
    if seconds < 59.5:
        return f"{seconds:.0f} s"
    return f"{format_clock(seconds)} {'h' if seconds >= 3599.5 else 'min'}"
