"""Ray-cast LiDAR scans of analytic scenes, with exact labels and ground heights."""

from gp_ground_seg.lab.simulation.objects import SEMANTIC_KITTI, Kind
from gp_ground_seg.lab.simulation.scan import HDL_64E, OS1_128, SENSORS, VLP_16, simulate_scan
from gp_ground_seg.lab.simulation.scenes import DRIVES, LOW, PLACES, SCENES, STEEP, Scene

__all__ = ['DRIVES', 'HDL_64E', 'LOW', 'OS1_128', 'PLACES', 'SCENES', 'SENSORS']
__all__ += ['SEMANTIC_KITTI', 'STEEP', 'VLP_16', 'Kind', 'Scene', 'simulate_scan']
