"""Data that scans come from: KITTI frames, bags, simulated scenes."""
