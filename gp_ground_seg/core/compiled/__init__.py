"""The stages of a frame, compiled with numba: a twin of each file by the same name."""
