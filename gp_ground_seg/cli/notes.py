"""Moved to `options`; goes when nothing imports it any more."""

from gp_ground_seg.cli.options import library_notes, note

__all__ = ['library_notes', 'note']
