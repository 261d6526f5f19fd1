"""Photographs whose names differ in the suffix alone must not share a render."""

from octasplat.engine.render.file_names import unique_render_names


def test_render_names_drop_suffix() -> None:
    assert unique_render_names(["a.jpg", "sub/b.png", "c.d.jpeg"]) == ("a", "sub/b", "c.d")


def test_same_stem_names_keep_suffix() -> None:
    assert unique_render_names(["a.jpg", "a.png", "b.png", "sub/a.png"]) == ("a.jpg", "a.png", "b", "sub/a")
    assert unique_render_names(["a.jpg", "A.png"]) == ("a.jpg", "A.png")


def test_render_names_avoid_collisions() -> None:
    photographs = ["a.jpg", "a.png", "a.jpg.png"]
    assert unique_render_names(photographs) == tuple(photographs)
