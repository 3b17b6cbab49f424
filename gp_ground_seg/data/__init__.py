"""Clouds in and out: files of scans, data sets, bags, messages."""
