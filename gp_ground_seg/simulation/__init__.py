"""Ray-cast LiDAR scans of analytic scenes, with exact labels and ground heights."""

from gp_ground_seg.simulation.kinds import SEMANTIC_KITTI_CLASS, Kind
from gp_ground_seg.simulation.kitti_writer import write_semantic_kitti
from gp_ground_seg.simulation.scan import (
    Scene,
    SimulatedScan,
    WetPatch,
    simulate_drive,
    simulate_scan,
)
from gp_ground_seg.simulation.scatter import MID_360, ScatterModel
from gp_ground_seg.simulation.scenes import SCENES
from gp_ground_seg.simulation.sensor import HDL_32E, HDL_64E, OS1_128, VLP_16, SensorModel

SENSORS: dict[str, SensorModel] = {
    sensor.name: sensor for sensor in (HDL_64E, HDL_32E, VLP_16, OS1_128, MID_360)
}
"""The preset sensors by name."""

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
    'simulate_drive',
    'simulate_scan',
    'write_semantic_kitti',
]
