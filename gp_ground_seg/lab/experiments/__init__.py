"""Experiments: configurations scored over frames."""
