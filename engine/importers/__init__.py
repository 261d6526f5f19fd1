"""Scenes of Gaussians read from any format: one small module a format, one registry."""

from engine.gaussians.flattening import ImportReport
from engine.importers.registry import Importer, importer_for, importers, read_scene, register

__all__ = ["ImportReport", "Importer", "importer_for", "importers", "read_scene", "register"]
