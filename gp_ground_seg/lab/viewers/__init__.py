"""Scans to turn, scrub and tune: Rerun, a page, a browser with sliders."""
