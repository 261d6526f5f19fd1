"""HTTP front end; it never imports torch, numba or the engine's numerical parts."""
