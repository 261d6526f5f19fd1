"""Photographs whose names differ in the suffix alone must not share a render."""

from octasplat.engine.render.names import render_names


def test_the_suffix_goes_where_it_tells_nothing() -> None:
    assert render_names(["a.jpg", "sub/b.png", "c.d.jpeg"]) == ("a", "sub/b", "c.d")


def test_names_that_differ_in_the_suffix_keep_it() -> None:
    assert render_names(["a.jpg", "a.png", "b.png", "sub/a.png"]) == ("a.jpg", "a.png", "b", "sub/a")
    assert render_names(["a.jpg", "A.png"]) == ("a.jpg", "A.png")


def test_what_a_kept_suffix_would_hit_is_avoided_too() -> None:
    photographs = ["a.jpg", "a.png", "a.jpg.png"]
    assert render_names(photographs) == tuple(photographs)
