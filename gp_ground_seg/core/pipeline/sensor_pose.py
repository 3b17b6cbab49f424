"""Stage 2: height and tilt of the sensor over the ground near it, from one scan (docs/pose.md)."""

import dataclasses
import math
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from gp_ground_seg.core.errors import PointCloudError
from gp_ground_seg.core.frame import FloatArray, PointArray, usual_errors
from gp_ground_seg.core.parameters.config import Config, SensorConfig
from gp_ground_seg.core.parameters.schema import AUTO
from gp_ground_seg.core.pipeline.ground_plane import CLEAR_TILT, GroundPlane
from gp_ground_seg.core.pipeline.ground_view import LOW, View, refusal
from gp_ground_seg.core.pipeline.points import Direction, angles_of, rotate, rotation, rounded

DEFAULT_HEIGHT = 1.73
"""Height where `sensor.height` is auto and the scan does not determine it: a car's roof [m]."""
NO_HEIGHT = (
    f'the scan does not show the ground near the sensor: sensor.height = {DEFAULT_HEIGHT:g} m is '
    'assumed; set it'
)
LOW_GROUND = (
    f'the ground seems to be less than {LOW:g} m below the sensor, and may be a table top: set '
    'sensor.height'
)
LITTLE_GROUND = (
    'the scan shows little ground near the sensor, and the height estimated from it may be wrong: '
    'set sensor.height'
)
LEAST_COSINE = 0.1
"""Cosine of the tilt from which the sensor's z axis meets the ground."""
HEIGHT_CONTRADICTION = 0.3
"""Difference to a given height from which the scan contradicts it [m]."""
TILT_CONTRADICTION = 0.15
"""Tilt left under given angles from which the scan contradicts them [rad]: no usual slope."""
REFERENCE_HEIGHT = 1.0
"""Height of a sensor over the ground from which parameters are used as they are given [m]."""
LOWEST = 0.1
"""Height below which the origin of a cloud is no sensor [m]."""
LEAST_TOLERANCE, NEARER = 0.04, 0.6
"""Least tolerance of ground that a low sensor leads to [m]: twice the noise of its ranges; factor
of its `grid.r_min`, of 1.2 times its height: a dome sees the ground that near."""


@dataclass(frozen=True)
class MeasuredPose:
    """Height and tilt of the sensor by one scan, whatever was given."""

    # of the cloud's origin over the ground plane, along the vertical of the pose used [m]
    height: float
    roll: float  # angle that would make the ground plane level [rad]
    pitch: float  # as `roll`
    tells_height: bool  # whether the scan shows enough ground for the height
    tells_tilt: bool  # the same for the tilt
    # in the frame levelled by the angles given, or where that is far from level in its own
    plane: GroundPlane
    # as `height`, over another level that is seen, higher or lower; infinite if there is none [m]
    other_height: float = math.inf


@dataclass(frozen=True)
class SensorPose:
    """The pose of the sensor that was used; the level frame has its origin and heading."""

    height: float  #: of the cloud's origin above the ground near it, negative below it [m]
    #: fixed-axis angles that turn the sensor frame level, as those of a URDF [rad]: positive roll
    #: lifts the left side, positive pitch lowers the nose (REP-103)
    roll: float
    pitch: float
    #: whether each comes from this scan rather than from the parameters or a default
    height_estimated: bool = False
    roll_estimated: bool = False
    pitch_estimated: bool = False
    measured: MeasuredPose | None = None  #: what the scan says; None if it shows no plane at all
    #: parameters that the scan clearly contradicts, a line for each; they are used as given
    contradictions: tuple[str, ...] = ()
    is_height_default: bool = False  #: whether the height is neither given nor shown by the scan
    #: why a height that comes from this scan may be wrong, a line for each
    doubts: tuple[str, ...] = ()
    #: whether `measured`, and the values that are not given, come from an earlier scan
    is_fallback: bool = False
    #: place of the sensor in the frame of the cloud, if it was given [m]
    origin: Direction = (0.0, 0.0, 0.0)

    @cached_property
    def sensor_height(self) -> float:
        """Height of the sensor above the ground near it, along the vertical [m]."""
        return self.height + float(self.rotation[2] @ self.origin)

    @property
    def starts_rays(self) -> bool:
        """Whether the ground is seen as from a sensor at the origin that was taken."""
        return self.measured is not None and self.measured.plane.is_below_sensor

    @property
    def is_well_seen(self) -> bool:
        """Whether the height comes from this scan, and nothing makes it doubtful."""
        return self.height_estimated and not self.doubts

    @property
    def is_level(self) -> bool:
        """Whether the level frame is the sensor's own."""
        return self.roll == 0.0 and self.pitch == 0.0

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings for the user, a line for each."""
        return (NO_HEIGHT,) * self.is_height_default + self.doubts

    @cached_property
    def rotation(self) -> FloatArray:
        """Matrix (3, 3) from the sensor frame to the level frame; not to be written to."""
        matrix = rotation(self.roll, self.pitch)
        matrix.flags.writeable = False
        return matrix

    def level(self, xyz: PointArray) -> PointArray:
        """Points (N, 3) of the sensor frame in the level frame; `xyz` itself without tilt."""
        if self.is_level:
            return xyz
        with usual_errors():
            return rotate(xyz, self.rotation)

    @usual_errors()
    def ground_z(self, z: PointArray, height: FloatArray) -> FloatArray:
        """Height of the surface along the sensor's z axis, sensor frame, (N,) float64 [m].

        `z`, in the sensor frame, and the vertical `height` over the surface are those of the
        points, (N,) [m]. Exact where the surface is level in the level frame; NaN if the axis
        lies within 6 degrees of the horizontal: it does not meet the ground.
        """
        cosine = math.cos(self.roll) * math.cos(self.pitch)
        if abs(cosine) < LEAST_COSINE:
            return np.full_like(height, np.nan)
        below: FloatArray = z - height / cosine
        return below


@lru_cache(maxsize=4)
def given_pose(sensor: SensorConfig) -> SensorPose:
    """Pose by the parameters alone: angles that are auto 0, a height that is auto the default."""
    return SensorPose(
        DEFAULT_HEIGHT if sensor.height == AUTO else sensor.height,
        0.0 if sensor.roll == AUTO else sensor.roll,
        0.0 if sensor.pitch == AUTO else sensor.pitch,
        is_height_default=sensor.height == AUTO,
        origin=(sensor.origin_x, sensor.origin_y, sensor.origin_z),
    )


def estimate_pose(
    sensor: SensorConfig, view: View | None, elsewhere: View | None, objection: str
) -> SensorPose:
    """Estimate what is auto, and check what is not against the scan.

    `view` is the plane of the ground, in the frame levelled by `given_pose`; without one,
    `objection` may say why. `elsewhere` is where the ground clearly lies if that is too far from
    z. Raises a PointCloudError if it is, and roll or pitch is auto.
    """
    given, contradictions = given_pose(sensor), tuple[str, ...]()
    if elsewhere is not None:
        contradictions = (refusal(elsewhere, given.rotation),)
        if AUTO in (sensor.roll, sensor.pitch):
            raise PointCloudError(*contradictions)
    doubts: tuple[str, ...] = (objection,) if objection and sensor.height == AUTO else ()
    if view is None:
        return dataclasses.replace(given, contradictions=contradictions, doubts=doubts)
    plane, tells_height = view.plane, view.tells_height
    up = given.rotation.T @ view.up
    pose = _levelled(given, up, sensor)
    if not view.tells_tilt or pose.rotation[2] @ given.rotation[2] > math.cos(CLEAR_TILT):
        pose = given
    # Along the vertical of the pose used, not across the plane.
    vertical = pose.rotation[2]
    height = plane.near_height * plane.normal[2] / (vertical @ up) - vertical @ pose.origin
    height = rounded(float(height))
    other = height + plane.other_height - plane.near_height
    measured = MeasuredPose(height, *angles_of(up), tells_height, view.tells_tilt, plane, other)
    estimates_height = sensor.height == AUTO and tells_height
    if estimates_height:
        is_low = plane.near_height * plane.normal[2] < LOW and plane.is_below_sensor
        doubts += (LOW_GROUND,) * bool(is_low) + (LITTLE_GROUND,) * (not view.is_whole)
    return dataclasses.replace(
        pose,
        height=height if estimates_height else given.height,
        height_estimated=estimates_height,
        measured=measured,
        contradictions=contradictions or _contradictions(sensor, measured, view),
        is_height_default=sensor.height == AUTO and not tells_height,
        doubts=doubts,
    )


def with_fallback(pose: SensorPose, fallback: SensorPose, sensor: SensorConfig) -> SensorPose:
    """Return `fallback` where `pose`, of this scan, has an estimated height that is not well seen.

    Angles that `sensor` gives, and what this scan contradicts, remain.
    """
    if sensor.height != AUTO or pose.is_well_seen:
        return pose
    return dataclasses.replace(
        given_pose(sensor),
        height=fallback.height,
        roll=fallback.roll if sensor.roll == AUTO else sensor.roll,
        pitch=fallback.pitch if sensor.pitch == AUTO else sensor.pitch,
        measured=fallback.measured,
        contradictions=pose.contradictions,
        is_height_default=False,
        is_fallback=True,
    )


def _levelled(given: SensorPose, up: FloatArray, sensor: SensorConfig) -> SensorPose:
    """Return `given` with angles that turn `up` upwards, as far as those given allow."""
    frees_roll, frees_pitch = sensor.roll == AUTO, sensor.pitch == AUTO
    roll = rounded(math.atan2(up[1], up[2])) if frees_roll else given.roll
    across = up[1] * math.sin(roll) + up[2] * math.cos(roll)
    pitch = rounded(math.atan2(-up[0], across)) if frees_pitch else given.pitch
    return dataclasses.replace(
        given, roll=roll, pitch=pitch, roll_estimated=frees_roll, pitch_estimated=frees_pitch
    )


def _contradictions(sensor: SensorConfig, measured: MeasuredPose, view: View) -> tuple[str, ...]:
    """Say which parameters are clearly wrong: another level that is seen as well may be meant."""
    found = []
    if view.is_surface and view.is_well_supported and sensor.height != AUTO:
        most = max(HEIGHT_CONTRADICTION, 0.1 * abs(sensor.height))
        seen = (measured.height, measured.other_height)
        if not any(abs(sensor.height - height) <= most for height in seen):
            side = 'below' if measured.height >= 0.0 else 'above'
            found.append(
                f'sensor.height = {sensor.height:g}: the ground near the sensor is '
                f"{abs(measured.height):.2f} m {side} the cloud's origin"
            )
    if measured.tells_tilt and view.up[2] < math.cos(TILT_CONTRADICTION):
        names = [n for n in ('roll', 'pitch') if getattr(sensor, n) != AUTO]
        if names:
            words = ', '.join(f'sensor.{name} = {getattr(sensor, name):g}' for name in names)
            found.append(
                f'{words}: the ground near the sensor is level with roll = '
                f'{measured.roll:.3f}, pitch = {measured.pitch:.3f}'
            )
    return tuple(found)


def for_sensor(config: Config, pose: SensorPose) -> Config:
    """Return `config` with what depends on the height of a low sensor in proportion to it.

    A small robot must stop for objects that a car drives over. Its level beams hit objects at the
    height of the sensor, for example 0.4 m: far from the last ring on the ground, a gate wider
    than that would accept trunks, persons and cars as ground.
    """
    share = sensor_height_of(pose) / REFERENCE_HEIGHT
    if share >= 1.0 or config.label.rule != 'roughness':
        return config
    shares = {
        'grid.r_min': NEARER * share,
        'growth.seed_height_tolerance': share,
        'growth.max_std': share,
        'label.ground_tolerance': share,
        'label.obstacle_min_height': share,
        'observation.slope_drift': share,
        'observation.sigma_n': math.sqrt(share),
    }
    least = {name: float(Config.find_spec(name).minimum or 0.0) for name in shares}
    least['label.ground_tolerance'] = min(LEAST_TOLERANCE, config.label.ground_tolerance)
    return config.replace(**{k: max(v * config[k], least[k]) for k, v in shares.items()})


def sensor_height_of(pose: SensorPose) -> float:
    """Height of a low sensor over the ground, `REFERENCE_HEIGHT` of others [m]."""
    is_there = pose.starts_rays and pose.sensor_height >= LOWEST
    return min(pose.sensor_height, REFERENCE_HEIGHT) if is_there else REFERENCE_HEIGHT
