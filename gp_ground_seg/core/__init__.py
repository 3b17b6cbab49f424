"""What a scan goes through, from points to labels; start with `segmenter`."""
