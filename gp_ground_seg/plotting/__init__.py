"""Pictures of scans and surfaces."""
