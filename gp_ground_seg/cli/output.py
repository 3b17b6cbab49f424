"""Moved to `options`; goes when nothing imports it any more."""

from gp_ground_seg.cli.options import count, note_leftovers, progress_bar

__all__ = ['count', 'note_leftovers', 'progress_bar']
