"""The stages of a frame, in plain numpy."""
