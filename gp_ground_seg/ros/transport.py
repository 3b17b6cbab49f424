"""Room for whole clouds in the shared memory of Fast DDS. No ROS is imported here."""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

MEGABYTE = 1 << 20
SEGMENT_SIZE = 32 * MEGABYTE
"""Shared memory that a process sends through, as in config/fastdds_large_clouds.xml."""
STOCK_SIZE = MEGABYTE // 2
"""The same without a profile: a quarter of a cloud of a 64-beam LiDAR."""
SHARE = 8
"""Part of the free shared memory that one process may take: a container has 64 MB in all."""
SHARED_MEMORY = Path('/dev/shm')

PROFILES_FILE = 'FASTRTPS_DEFAULT_PROFILES_FILE'
_USERS_CHOICE = (PROFILES_FILE, 'FASTDDS_DEFAULT_PROFILES_FILE', 'FASTDDS_BUILTIN_TRANSPORTS')

PROFILE = """\
<?xml version="1.0" encoding="UTF-8" ?>
<dds xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles">
  <profiles>
    <transport_descriptors>
      <transport_descriptor>
        <transport_id>large_shared_memory</transport_id>
        <type>SHM</type>
        <segment_size>{segment_size}</segment_size>
      </transport_descriptor>
      <transport_descriptor>
        <transport_id>udp</transport_id>
        <type>UDPv4</type>
      </transport_descriptor>
    </transport_descriptors>
    <participant profile_name="large_clouds" is_default_profile="true">
      <rtps>
        <userTransports>
          <transport_id>large_shared_memory</transport_id>
          <transport_id>udp</transport_id>
        </userTransports>
        <useBuiltinTransports>false</useBuiltinTransports>
      </rtps>
    </participant>
  </profiles>
</dds>
"""


@contextlib.contextmanager
def large_cloud_transport() -> Iterator[None]:
    """Let Fast DDS send whole clouds through shared memory.

    A cloud that does not fit into a process's shared memory is sent piece by piece,
    and pieces get lost whenever the receiver is not fast enough; reliable delivery
    repeats them, but may take 3 s to notice, while newer clouds push the old one out
    of the queue. Two clouds sent at once, as by the node, suffice for that.

    Works on this process, if it uses ROS for the first time within the block, and on
    those started within it. Does nothing if the user has chosen a profile or a
    transport, if shared memory is short, and to other middlewares.
    """
    size = segment_size()
    if size <= STOCK_SIZE or any(os.environ.get(name) for name in _USERS_CHOICE):
        yield
        return
    with tempfile.TemporaryDirectory(prefix='gp_ground_seg-') as folder:
        file = Path(folder, 'fastdds.xml')
        file.write_text(PROFILE.format(segment_size=size), encoding='utf-8')
        before = os.environ.get(PROFILES_FILE)
        os.environ[PROFILES_FILE] = str(file)
        try:
            yield
        finally:
            if before is None:
                del os.environ[PROFILES_FILE]
            else:
                os.environ[PROFILES_FILE] = before


def segment_size() -> int:
    """Return the shared memory that this process may take [bytes], 0 where there is none."""
    try:
        status = os.statvfs(SHARED_MEMORY)
    except OSError:
        return 0
    return min(SEGMENT_SIZE, status.f_bavail * status.f_frsize // SHARE)
