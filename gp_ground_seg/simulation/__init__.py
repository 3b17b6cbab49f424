"""Ray-cast LiDAR scans of analytic scenes, with exact labels and ground heights."""

from gp_ground_seg.simulation.objects import SEMANTIC_KITTI_CLASS, Kind, semantic_kitti_labels
from gp_ground_seg.simulation.scan import (
    SimulatedScan,
    simulate_drive,
    simulate_scan,
    write_semantic_kitti,
)
from gp_ground_seg.simulation.scenes import SCENES, Scene, WetPatch
from gp_ground_seg.simulation.sensor import (
    HDL_32E,
    HDL_64E,
    MID_360,
    OS1_128,
    SENSORS,
    VLP_16,
    ScatterModel,
    SensorModel,
)

__all__ = [
    'HDL_32E',
    'HDL_64E',
    'MID_360',
    'OS1_128',
    'SCENES',
    'SEMANTIC_KITTI_CLASS',
    'SENSORS',
    'VLP_16',
    'Kind',
    'ScatterModel',
    'Scene',
    'SensorModel',
    'SimulatedScan',
    'WetPatch',
    'semantic_kitti_labels',
    'simulate_drive',
    'simulate_scan',
    'write_semantic_kitti',
]
