"""Moved to `options`; goes when nothing imports it any more."""

from gp_ground_seg.cli.options import positive, some_of

__all__ = ['positive', 'some_of']
