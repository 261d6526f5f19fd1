"""Photographs one by one: their poses, exposures, and how well they fit."""
