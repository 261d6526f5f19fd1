"""The HTTP front end. Never imports torch, numba or the engine's numerical parts."""
