"""The relief of the land as loops: a slow oracle of both backends (see `reference`)."""

import itertools
import math

import numpy as np


def find_relief(candidates, faces, height, config):
    """Heights in the middle of each square of the land before falls, and of that behind them.

    Also which pieces are of the latter. Two of (60, 60), and (59, 59).
    """
    lands, is_behind = np.zeros((2, 60, 60)), np.zeros((59, 59), dtype=bool)
    if config.surface.look_aside:
        known, pieces = [], []
        for side in map(sorted, reached_on_foot(candidates, faces, height, config)):
            x, y, z = (getattr(candidates, name)[side] for name in 'xyz')
            heights = fit_squares(x, y, z + height)
            known.append(heights)
            pieces.append(pieces_on(heights, x, y))
        if any(abs(h) > 0.15 for heights in known for h in heights.values()):
            for land, heights in zip(lands, known, strict=True):
                fill_rings(heights)
                for square, h in heights.items():
                    share = min(max((abs(h) - 0.15) / 0.3, 0.0), 1.0)
                    land[square] = h * (3.0 * share**2 - 2.0 * share**3)
            for piece in np.ndindex(59, 59):
                before, behind = (rings_to(piece, own) for own in pieces)
                is_behind[piece] = behind < before
    return *lands, is_behind


def pieces_on(heights, x, y):
    """Pieces, each between the middles of four squares, with places in squares of a height."""
    squares = squares_of(x, y)
    places = [(a, b) for a, b, square in zip(x, y, squares, strict=True) if square in heights]
    return {tuple(min(max(int((v + 59.0) // 2.0), 0), 58) for v in place) for place in places}


def rings_to(piece, others):
    """Rings of pieces around one up to the nearest of others."""
    return min((max(abs(piece[0] - i), abs(piece[1] - j)) for i, j in others), default=math.inf)


def reached_on_foot(candidates, faces, height, config):
    """Candidates in the groups, joined by steps, that have eight seeds; raised parts entered.

    Those before a fall, and those behind one.
    """
    r, z, segment = candidates.r, candidates.z, candidates.segment
    n_segments, growth = len(candidates.offsets) - 1, config.growth
    allowed = {c for c in range(len(r)) if r[c] < 60.0 and not faces.is_face[candidates.tile[c]]}
    beside, steep, falls = {c: set() for c in allowed}, [], []

    def join(a, b):
        beside[a].add(b)
        beside[b].add(a)

    def step(a, b, longest, across):
        rise, distance = abs(z[b] - z[a]), math.hypot(r[b] - r[a], across)
        is_step = {a, b} <= allowed and abs(r[b] - r[a]) <= longest
        is_step &= rise <= min(0.84 * distance + 0.06, 0.8 if across == 0.0 else 0.3)
        if is_step and rise <= 0.3:
            join(a, b)
        elif is_step:
            steep.append((a, b))
        return is_step

    for a in sorted(allowed):
        if {a, a + 1} <= allowed and segment[a + 1] == segment[a]:
            gap, dr, rise = 1.0 + 0.12 * r[a + 1], r[a + 1] - r[a], z[a + 1] - z[a]
            if dr > gap and goes_on(candidates, a):
                steep.append((a, a + 1))
            elif not step(a, a + 1, gap, 0.0) and leads_over_edge(dr, rise):
                falls.append((a, a + 1))
        for aside in (1, 2):
            own = np.flatnonzero(segment == (segment[a] + aside) % n_segments)
            across = aside * 2.0 * math.pi / n_segments * r[a]
            for b in (*own[r[own] < r[a]][-1:], *own[r[own] >= r[a]][:1]):
                step(a, int(b), 0.5 * (1.0 + 0.12 * r[a]), across)
    fallen = set()
    for steps in (steep, [(a, b) for a, b in steep + falls if z[b] < z[a]]):
        for front in fronts_of(steps, r, z, segment, n_segments):
            if sum(2.0 * math.pi / n_segments * r[a] for a, _ in front) >= 6.0:
                fallen |= front & set(falls)
                for a, b in front - set(falls):
                    join(a, b)
    raised = {c for c in allowed if z[c] + height > 0.3}
    land = set(allowed)
    for part in groups_of(raised, lambda c: beside[c] & raised):
        entries = {c for c in part if beside[c] - raised}
        nearest = {
            segment[c]: min(r[e] for e in entries if segment[e] == segment[c]) for c in entries
        }
        if sum(2.0 * math.pi / n_segments * r_entry for r_entry in nearest.values()) < 1.5:
            land -= part
    fallen = {step for step in fallen if set(step) <= land}
    for a, b in fallen:
        join(a, b)
    seeds = {
        c
        for c in allowed
        if r[c] < growth.seed_range and abs(z[c] + height) < growth.seed_height_tolerance
    }
    groups = groups_of(allowed, lambda c: beside[c])
    reached = {c for group in groups if len(seeds & group) >= 8 for c in group} & land
    behind = set()
    for c in reached:
        edges = [a for a, b in fallen if b in reached and segment[b] == segment[c] and b <= c]
        if edges and z[c] < z[max(edges)] - 0.8:
            behind.add(c)
    return reached - behind, behind


def leads_over_edge(dr, rise):
    """Whether a step along a segment leads down over an edge."""
    return rise < -0.8 and rise < -0.06 * dr and dr > 2.0 * math.sqrt(2.0)


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


def squares_of(x, y):
    """Square of each place."""
    return [
        (min(int(a // 2.0) + 30, 59), min(int(b // 2.0) + 30, 59))
        for a, b in zip(x, y, strict=True)
    ]


def fit_squares(x, y, z):
    """Height in the middle of each square that has a plane, after three fits."""
    squares = squares_of(x, y)
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
    return known


def fit_plane(x, y, z, weight):
    """Weighted least squares with 0.5 m^2 added to the variances of x and y."""
    mean = np.average([x, y, z], axis=1, weights=weight)
    cov = np.cov([x, y, z], aweights=weight, ddof=0) if len(x) > 1 else np.zeros((3, 3))
    slope = np.linalg.solve(cov[:2, :2] + 0.5 * np.eye(2), cov[:2, 2])
    is_determined = weight.sum() >= 1.5
    return lambda a, b: (mean[2] + slope @ [a - mean[0], b - mean[1]], is_determined)


def fill_rings(known):
    """Give each unknown square the mean of those around it, ring by ring."""
    while known and len(known) < 3600:
        means = {}
        for square in itertools.product(SIDES, SIDES):
            heights = [known[other] for other in around(square) if other in known]
            if square not in known and heights:
                means[square] = float(np.mean(heights))
        known.update(means)
