"""Ray-cast LiDAR scans of analytic scenes, with exact labels and ground heights."""

from gp_ground_seg.datasets.simulator.kinds import SEMANTIC_KITTI_CLASS, Kind
from gp_ground_seg.datasets.simulator.kitti_writer import write_semantic_kitti
from gp_ground_seg.datasets.simulator.scan import (
    Scene,
    SimulatedScan,
    WetPatch,
    simulate_drive,
    simulate_scan,
)
from gp_ground_seg.datasets.simulator.scenes import SCENES
from gp_ground_seg.datasets.simulator.sensor import (
    HDL_32E,
    HDL_64E,
    OS1_128,
    SENSORS,
    VLP_16,
    SensorModel,
)

__all__ = [
    'HDL_32E',
    'HDL_64E',
    'OS1_128',
    'SCENES',
    'SEMANTIC_KITTI_CLASS',
    'SENSORS',
    'VLP_16',
    'Kind',
    'Scene',
    'SensorModel',
    'SimulatedScan',
    'WetPatch',
    'simulate_drive',
    'simulate_scan',
    'write_semantic_kitti',
]
