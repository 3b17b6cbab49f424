"""Ray-cast LiDAR scans of analytic scenes, with exact labels and ground heights."""

from gp_ground_seg.simulation.objects import SEMANTIC_KITTI_CLASS, Kind, semantic_kitti_labels
from gp_ground_seg.simulation.scan import simulate_drive, simulate_scan, write_semantic_kitti
from gp_ground_seg.simulation.scenes import SCENES, Scene, WetPatch
from gp_ground_seg.simulation.sensor import HDL_32E, HDL_64E, MID_360, OS1_128, SENSORS, VLP_16

__all__ = ['HDL_32E', 'HDL_64E', 'MID_360', 'OS1_128', 'SCENES', 'SEMANTIC_KITTI_CLASS']
__all__ += ['SENSORS', 'VLP_16', 'Kind', 'Scene', 'WetPatch', 'semantic_kitti_labels']
__all__ += ['simulate_drive', 'simulate_scan', 'write_semantic_kitti']
