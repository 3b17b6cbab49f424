"""Quality of service of the cloud topics."""

from __future__ import annotations

from collections.abc import Collection, Mapping

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from gp_ground_seg.errors import ConfigError

INPUT_DEPTH = 5
"""Clouds that may wait to be processed: half a second of a LiDAR at 10 Hz."""
OUTPUT_DEPTH = 20
"""Clouds a sender keeps for repair: with stock Fast DDS, a lost fragment of a large cloud
takes up to 0.7 s to be sent again on a busy machine; what is overwritten by then is lost."""

LARGEST_DEPTH = 10_000
QOS_OVERRIDES = 'qos_overrides.'
_CHOICES = {
    'reliability': ('reliable', 'best_effort', 'best_available', 'system_default'),
    'history': ('keep_last', 'keep_all', 'system_default'),
}


def check_overrides(given: Mapping[str, object]) -> None:
    """Check the values of ``qos_overrides`` parameters, whatever their topic.

    Raises
    ------
    ConfigError
        If one is not accepted.
    """
    for name, value in given.items():
        policy = name.rpartition('.')[2]
        if not name.startswith(QOS_OVERRIDES):
            continue
        if policy == 'depth':
            if (
                isinstance(value, bool)
                or not isinstance(value, int)
                or not (1 <= value <= LARGEST_DEPTH)
            ):
                accepted = f'an integer in [1, {LARGEST_DEPTH}]'
                raise ConfigError(f'{name} = {value!r}: must be {accepted}')
        elif policy in _CHOICES and value not in _CHOICES[policy]:
            choices = ', '.join(_CHOICES[policy])
            raise ConfigError(f'{name} = {value!r}: must be one of {choices}')


def cloud_profile(depth: int = OUTPUT_DEPTH) -> QoSProfile:
    """Return what a cloud topic starts with: reliable, volatile, the newest `depth` clouds."""
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.VOLATILE,
    )


def matching_reliability(offered: Collection[ReliabilityPolicy]) -> ReliabilityPolicy:
    """Return the strongest reliability that receives from every publisher.

    Large clouds need reliable delivery: a best-effort reader loses most of a
    replayed KITTI bag with stock Fast DDS. A reliable reader gets nothing from
    a best-effort LiDAR driver.
    """
    if ReliabilityPolicy.BEST_EFFORT in offered:
        return ReliabilityPolicy.BEST_EFFORT
    return ReliabilityPolicy.RELIABLE


def in_words(profile: QoSProfile) -> str:
    """Return `profile` as in ``reliable, keep_last 5, volatile``."""
    reliability, history, durability = (
        policy.name.lower()
        for policy in (profile.reliability, profile.history, profile.durability)
    )
    return f'{reliability}, {history} {profile.depth}, {durability}'
