"""The relief of the land as loops: a slow oracle of both backends (see `reference`)."""

import itertools
import math

import numpy as np


def find_relief(candidates, faces, height, config):
    """Heights of the relief in the middle of each square, (60, 60)."""
    land = np.zeros((60, 60))
    if config.surface.look_aside:
        reached = sorted(reached_on_foot(candidates, faces, height, config))
        x, y, z = (value[reached] for value in (candidates.x, candidates.y, candidates.z + height))
        known, occupied = fit_squares(x, y, z)
        for square in raised_parts(known, occupied):
            del known[square]
        if any(abs(h) > 0.15 for h in known.values()):
            fill_rings(known)
            for square, h in known.items():
                share = min(max((abs(h) - 0.15) / 0.3, 0.0), 1.0)
                land[square] = h * (3.0 * share**2 - 2.0 * share**3)
    return land


def reached_on_foot(candidates, faces, height, config):
    """Candidates in the groups, joined by steps, that have eight seeds; raised parts entered."""
    r, z, segment = candidates.r, candidates.z, candidates.segment
    n_segments, growth = len(candidates.offsets) - 1, config.growth
    allowed = {c for c in range(len(r)) if r[c] < 60.0 and not faces.is_face[candidates.tile[c]]}
    beside, steep = {c: set() for c in allowed}, []

    def step(a, b, longest, across):
        rise, distance = abs(z[b] - z[a]), math.hypot(r[b] - r[a], across)
        is_step = {a, b} <= allowed and abs(r[b] - r[a]) <= longest
        if is_step and rise <= min(0.84 * distance + 0.06, 0.8 if across == 0.0 else 0.3):
            if rise <= 0.3:
                beside[a].add(b)
                beside[b].add(a)
            else:
                steep.append((a, b))

    for a in sorted(allowed):
        if a + 1 < len(r) and segment[a + 1] == segment[a]:
            if r[a + 1] - r[a] > 1.0 + 0.12 * r[a + 1]:
                if {a, a + 1} <= allowed and goes_on(candidates, a):
                    steep.append((a, a + 1))
            else:
                step(a, a + 1, 1.0 + 0.12 * r[a + 1], 0.0)
        for aside in (1, 2):
            own = np.flatnonzero(segment == (segment[a] + aside) % n_segments)
            across = aside * 2.0 * math.pi / n_segments * r[a]
            for b in (*own[r[own] < r[a]][-1:], *own[r[own] >= r[a]][:1]):
                step(a, int(b), 0.5 * (1.0 + 0.12 * r[a]), across)
    for front in fronts_of(steep, r, z, segment, n_segments):
        if sum(2.0 * math.pi / n_segments * r[a] for a, _ in front) >= 6.0:
            for a, b in front:
                beside[a].add(b)
                beside[b].add(a)
    groups = groups_of(allowed, lambda c: beside[c])
    seeds = {
        c
        for c in allowed
        if r[c] < growth.seed_range and abs(z[c] + height) < growth.seed_height_tolerance
    }
    reached = {c for group in groups if len(seeds & group) >= 8 for c in group}
    raised = {c for c in reached if z[c] + height > 0.3}
    for part in groups_of(raised, lambda c: beside[c] & raised):
        entries = {c for c in part if beside[c] & (reached - raised)}
        nearest = {
            segment[c]: min(r[e] for e in entries if segment[e] == segment[c]) for c in entries
        }
        if sum(2.0 * math.pi / n_segments * r_entry for r_entry in nearest.values()) < 1.5:
            reached -= part
    return reached


def goes_on(candidates, a):
    """Whether the long step from candidate `a` to the next has the slope of the land before it."""
    r, z, segment = candidates.r, candidates.z, candidates.segment
    dr = r[a + 1] - r[a]
    own = np.flatnonzero((segment == segment[a]) & (r <= r[a] - 0.5 * dr))
    if len(own) == 0 or dr > 1.0 + 0.4 * r[a + 1]:
        return False
    before = (z[a] - z[own[-1]]) / (r[a] - r[own[-1]])
    slope = (z[a + 1] - z[a]) / dr
    return 0.06 <= abs(slope) <= 0.84 and abs(slope - before) <= 0.08


def fronts_of(steep, r, z, segment, n_segments):
    """Steps, pairs of candidates, in groups of those side by side."""
    beside = {step: set() for step in steep}
    for a, b in steep:
        for aside in (1, 2):
            own = [s for s in steep if segment[s[0]] == (segment[a] + aside) % n_segments]
            for c, d in sorted(s for s in own if r[s[1]] >= r[a])[:2]:
                overlap = max(min(z[a], z[b]), min(z[c], z[d])) <= min(
                    max(z[a], z[b]), max(z[c], z[d])
                )
                if overlap and r[c] <= r[b]:
                    beside[a, b].add((c, d))
                    beside[c, d].add((a, b))
    return groups_of(steep, lambda step: beside[step])


def groups_of(members, neighbours):
    """Connected groups of the members, a set each."""
    left, groups = set(members), []
    while left:
        group = front = {left.pop()}
        while front:
            front = {other for one in front for other in neighbours(one) if other in left}
            left, group = left - front, group | front
        groups.append(group)
    return groups


def around(square):
    """The square and those around it, of 60 by 60."""
    i, j = square
    return [(a, b) for a in range(i - 1, i + 2) for b in range(j - 1, j + 2) if {a, b} <= SIDES]


SIDES = set(range(60))


def fit_squares(x, y, z):
    """Height in the middle of each square that has a plane, after three fits."""
    squares = [
        (min(int(a // 2.0) + 30, 59), min(int(b // 2.0) + 30, 59))
        for a, b in zip(x, y, strict=True)
    ]
    own = {square: np.flatnonzero([s == square for s in squares]) for square in set(squares)}
    weight = np.array([1.0 / len(own[square]) for square in squares])
    for _ in range(3):
        planes = {}
        for square in itertools.product(SIDES, SIDES):
            near = [c for other in around(square) for c in own.get(other, ())]
            if near:
                planes[square] = fit_plane(x[near], y[near], z[near], weight[near])
        for c, square in enumerate(squares):
            residual = z[c] - planes[square](x[c], y[c])[0]
            weight[c] = 1.0 / len(own[square]) / (1.0 + (residual / 0.15) ** 2)
    middles = {square: [2.0 * k - 59.0 for k in square] for square in planes}
    heights = {square: planes[square](*middles[square]) for square in planes}
    known = {square: h for square, (h, is_determined) in heights.items() if is_determined}
    return known, set(squares)


def fit_plane(x, y, z, weight):
    """Weighted least squares with 0.5 m^2 added to the variances of x and y."""
    mean = np.average([x, y, z], axis=1, weights=weight)
    cov = np.cov([x, y, z], aweights=weight, ddof=0) if len(x) > 1 else np.zeros((3, 3))
    slope = np.linalg.solve(cov[:2, :2] + 0.5 * np.eye(2), cov[:2, 2])
    is_determined = weight.sum() >= 1.5
    return lambda a, b: (mean[2] + slope @ [a - mean[0], b - mean[1]], is_determined)


def raised_parts(known, occupied):
    """Squares that are 0.3 m high or deep, with fewer than nine occupied ones side by side."""
    raised = {square for square, h in known.items() if abs(h) > 0.3}

    def beside(square):
        return [s for s in around(square) if abs(s[0] - square[0]) + abs(s[1] - square[1]) == 1]

    return [square for g in groups_of(raised, beside) if len(g & occupied) < 9 for square in g]


def fill_rings(known):
    """Give each unknown square the mean of those around it, ring by ring."""
    while len(known) < 3600:
        means = {}
        for square in itertools.product(SIDES, SIDES):
            heights = [known[other] for other in around(square) if other in known]
            if square not in known and heights:
                means[square] = float(np.mean(heights))
        known.update(means)
