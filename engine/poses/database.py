"""How far COLMAP is, read from its database while it writes."""

import sqlite3
from contextlib import closing
from pathlib import Path


def feature_counts(database: Path) -> dict[str, int]:
    """Number of features of each photograph that has been looked at; empty while the database is busy."""
    query = "SELECT images.name, keypoints.rows FROM images JOIN keypoints USING (image_id)"
    return {str(name): int(rows) for name, rows in _rows(database, query)}


def pairs_matched(database: Path) -> int:
    """Number of pairs of photographs that have been compared; 0 while the database is busy."""
    rows = _rows(database, "SELECT count(*) FROM two_view_geometries")
    return int(rows[0][0]) if rows else 0


def _rows(database: Path, query: str) -> list[tuple[str | int, ...]]:
    if not database.exists():
        return []
    try:
        with closing(
            sqlite3.connect(f"{database.resolve().as_uri()}?mode=ro", uri=True, timeout=0.2)
        ) as found:
            return found.execute(query).fetchall()
    except sqlite3.Error:  # locked, or its tables are being made
        return []
