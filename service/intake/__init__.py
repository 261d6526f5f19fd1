"""Validation of uploads: names, archives, images and COLMAP models.

Nothing here imports pycolmap, torch or numba; a model is only ever parsed in a child process.
"""
