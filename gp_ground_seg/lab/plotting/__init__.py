"""Pictures of scans, ground models and benchmarks; the only folder that imports matplotlib.

Every function that draws raises `MissingDependencyError` where matplotlib is not installed, and
`DataError` where the file cannot be written.
"""
