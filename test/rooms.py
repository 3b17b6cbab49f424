"""Rooms whose ceiling is seen, as scenes of the simulator."""

import itertools

from gp_ground_seg.lab.simulation import Scene
from gp_ground_seg.lab.simulation import terrain as landforms
from gp_ground_seg.lab.simulation.objects import floating_box, wall


def room(name, ends, ceiling=False):
    ground = landforms.flat()
    solids = [s for a, b in itertools.pairwise([*ends, ends[0]]) for s in wall(ground, a, b, 3.0)]
    if ceiling:
        solids.append(floating_box(ground, 2.0, 1.0, (20.0, 12.0, 0.2), 3.0))
    return Scene(name, ground, tuple(solids))


HALL = room('hall', [(-8.0, -5.0), (12.0, -5.0), (12.0, 7.0), (-8.0, 7.0)], ceiling=True)
ROOM, SMALL_ROOM = (
    room('room', [(-a, -a), (a, -a), (a, a), (-a, a)], ceiling=True) for a in (5.0, 4.5)
)
CORRIDOR = room('corridor', [(-20.0, -0.6), (20.0, -0.6), (20.0, 0.6), (-20.0, 0.6)])
