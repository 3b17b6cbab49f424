"""Quality of service of the cloud topics."""

from __future__ import annotations

from collections.abc import Collection

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

INPUT_DEPTH = 5
"""Clouds that may wait to be processed: half a second of a LiDAR at 10 Hz."""
OUTPUT_DEPTH = 20
"""Clouds a sender keeps for repair: with stock Fast DDS, a lost fragment of a large cloud
takes up to 0.7 s to be sent again on a busy machine; what is overwritten by then is lost."""


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
