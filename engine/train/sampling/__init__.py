"""Rays and pixels that are drawn from the photographs."""
