"""The folder of a run, its configuration, and the catalog of settings."""
