"""The way of a scan from points to labels; start with `segmenter`."""
