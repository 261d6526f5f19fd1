"""Files for other programs: one small module a format, all found by `engine.export.registry`."""
