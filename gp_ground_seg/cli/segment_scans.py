"""Moved to `segment`; goes when nothing imports it any more."""

from gp_ground_seg.cli.segment import find_scans

__all__ = ['find_scans']
