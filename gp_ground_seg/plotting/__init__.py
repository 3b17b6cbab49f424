"""Pictures of scans, ground models and benchmarks; the only folder that imports matplotlib."""
