"""Newton's method for the resting chain, and the random motions that take hundreds of its solutions, by numba.

Both are in one file: numba keeps compiled code on disk until the file itself changes, whatever that code calls.
"""

from __future__ import annotations

import numpy as np

from cablejax.compiled_programs import kept_on_disk

_MAX_ITERATIONS = 200
_MAX_TURN = 0.2  # largest change of a joint angle in one iteration [rad]
_MAX_STRETCH = 0.2  # largest correction of the far end in one iteration, relative to the length
_TOLERANCE = 1e-10
_SAFE_CURVATURE = 1e-3  # smallest pivot [1 / h] from which on the reduced Hessian counts as positive
_LEAST_CURVATURE = 1e-6  # smaller eigenvalues count as this [1 / h]
_MAX_REDRAWS = 50


@kept_on_disk
def settle(lengths, pose, guess):
    """Joint angles at which the chain rests, near a guess; half-length links at the ends.

    Args:
        lengths: of the links [m], shape [n].
        pose: of the two grippers (x, y, theta), float64, shape [2, 3].
        guess: joint angles [rad], shape [n - 1].

    Returns:
        Joint angles [rad], shape [n - 1]; smallest eigenvalue of the energy's second derivative along the constraints
        [1 / m], for EI = 1, NaN = not settled; remaining error of the far end.
    """
    angles, settled, free, off = _newton(lengths, pose, guess)
    return angles, np.linalg.eigh(free)[0][0] if settled else np.nan, off


@kept_on_disk
def _newton(lengths, pose, guess):
    """Joint angles, whether they have settled, the second derivative along the constraints, error of the far end."""
    h, length, n = lengths[1], lengths.sum(), len(guess)
    angles, off, free = guess.copy(), np.inf, np.empty((n - 3, n - 3))
    beyond, error = np.empty((n, 2)), np.empty(3)
    for _ in range(_MAX_ITERATIONS):
        _far_end(lengths, pose, angles, beyond, error)
        off = np.abs(error).max()
        jacobian = np.empty((3, n))
        jacobian[0], jacobian[1], jacobian[2] = -beyond[:, 1], beyond[:, 0], 1.0
        gram, along, gradient = np.empty((3, 3)), np.empty(3), angles / h
        for i in range(3):
            along[i] = _dot(jacobian[i], gradient)
            for j in range(3):
                gram[i, j] = _dot(jacobian[i], jacobian[j])
        # of the three conditions a straight cable leaves one without effect: the floor is for it
        size = gram[0, 0] + gram[1, 1] + gram[2, 2]
        tension = _solve(gram, along, 1e-9 * size, 1e-12 * size)
        shrink = min(1.0, _MAX_STRETCH * length / max(off, 1e-300))
        pull = _solve(gram, shrink * error, 1e-9 * size, 1e-12 * size)
        correction = pull[0] * jacobian[0] + pull[1] * jacobian[1] + pull[2] * jacobian[2]

        hessian = np.empty((n, n))
        for i in range(n):
            for j in range(i + 1):
                hessian[i, j] = hessian[j, i] = tension[0] * beyond[i, 0] + tension[1] * beyond[i, 1]
            hessian[i, i] += 1.0 / h
        slope = gradient + _product(hessian, correction)
        mirrors = _mirrors(jacobian)
        for mirror in mirrors:
            _reflect(mirror, hessian)
            slope -= 2.0 * _dot(mirror, slope) * mirror
        free = hessian[3:, 3:].copy()
        step = np.zeros(n)
        step[3:] = -_solve(free, slope[3:].copy(), _SAFE_CURVATURE / h, _LEAST_CURVATURE / h)
        for k in range(2, -1, -1):
            step -= 2.0 * _dot(mirrors[k], step) * mirrors[k]
        step += correction
        largest = np.abs(step).max()
        angles += min(1.0, _MAX_TURN / max(largest, 1e-300)) * step
        if largest < _TOLERANCE and off < 1e-8:
            return angles, True, free, off
    return angles, False, free, off


@kept_on_disk
def walk(rng, lengths, pose, angles, count, interval, unit, persistence, rest_probability, bound, reach, limits):
    """Twists of a random motion that keeps to its limits [m/s, rad/s], shape [count, 2, 3].

    Args:
        rng: source of all randomness.
        lengths: of the links of a coarse chain [m], shape [n]; half-length links at the ends.
        pose: of the two grippers at the start (x, y, theta), float64, shape [2, 3].
        angles: joint angles at which that chain rests there [rad], shape [n - 1].
        count: number of twists.
        interval: for which each is held [s].
        unit: the twist that a proposal of one stands for [m/s, rad/s], shape [3].
        persistence: correlation of a proposal with the one before.
        rest_probability: chance that the grippers stand still during an interval.
        bound: of one gripper's `sqrt(vx^2 + vy^2 + (weight omega)^2)` [m/s], and the weight [m/rad].
        reach: largest movement of any point of the resting chain, relative to the sum of what the grippers move.
        limits: see `admissible`.
    """
    fastest, weight = bound
    nodes, twists = joints(lengths, pose, angles), np.zeros((count, 2, 3))
    innovation, velocity = np.sqrt(1.0 - persistence**2), rng.standard_normal((2, 3))
    for t in range(count):
        if rng.random() < rest_probability:
            continue
        proposal = persistence * velocity + innovation * rng.standard_normal((2, 3))
        velocity = np.zeros((2, 3))
        for _ in range(_MAX_REDRAWS):
            twist, moved = proposal * unit, 0.0
            for q in range(2):
                speed = np.sqrt(twist[q, 0] ** 2 + twist[q, 1] ** 2 + (weight * twist[q, 2]) ** 2)
                twist[q] *= min(1.0, fastest / max(speed, 1e-12))
                moved += interval * min(speed, fastest)
            following = pose + interval * twist
            if admissible(following, limits):
                rest, settled, _, _ = _newton(lengths, following, angles)
                there = joints(lengths, following, rest)
                if settled and _furthest(there, nodes) <= reach * moved:
                    velocity, twists[t], pose, angles, nodes = proposal, twist, following, rest, there
                    break
            proposal = rng.standard_normal((2, 3))
    return twists


@kept_on_disk
def admissible(pose, limits):
    """See `cablejax.simulate.motions.admissible`.

    Args:
        pose: of the two grippers (x, y, theta), float64, shape [2, 3].
        limits: least distance of the grippers [m], the largest of straight ones [m], largest curvature [1/m] and
            largest angle between a gripper and the line through both [rad].
    """
    x, y = pose[1, 0] - pose[0, 0], pose[1, 1] - pose[0, 1]
    heading, distance, detour = np.arctan2(y, x), np.sqrt(x * x + y * y), 0.0
    for q in range(2):
        angle = np.abs((pose[q, 2] - heading + np.pi) % (2 * np.pi) - np.pi)
        if angle > limits[3]:
            return False
        detour += 2.0 / limits[2] * (angle - np.sin(angle))
    return distance >= limits[0] and distance <= limits[1] - detour


@kept_on_disk
def joints(lengths, pose, angles):
    """Positions of the joints of the chain that leaves gripper 0 [m], shape [n - 1, 2]."""
    theta, (x, y) = pose[0, 2], pose[0, :2]
    nodes = np.empty((len(angles), 2))
    for i in range(len(angles)):
        x, y = x + lengths[i] * np.cos(theta), y + lengths[i] * np.sin(theta)
        nodes[i, 0], nodes[i, 1] = x, y
        theta += angles[i]
    return nodes


@kept_on_disk
def _furthest(one, other):
    """Largest distance of two points of the same number [m]."""
    largest = 0.0
    for i in range(len(one)):
        largest = max(largest, (one[i, 0] - other[i, 0]) ** 2 + (one[i, 1] - other[i, 1]) ** 2)
    return np.sqrt(largest)


@kept_on_disk
def _far_end(lengths, pose, angles, beyond, error):
    """Writes what lies beyond every joint [m] and by how much the far end misses its gripper."""
    theta, n = pose[0, 2], len(angles)
    steps = np.empty((n + 1, 2))
    for i in range(n + 1):
        if i > 0:
            theta += angles[i - 1]
        steps[i, 0], steps[i, 1] = lengths[i] * np.cos(theta), lengths[i] * np.sin(theta)
    x = y = 0.0
    for i in range(n, 0, -1):
        x, y = x + steps[i, 0], y + steps[i, 1]
        beyond[i - 1, 0], beyond[i - 1, 1] = x, y
    error[0] = pose[1, 0] - pose[0, 0] - steps[0, 0] - x
    error[1] = pose[1, 1] - pose[0, 1] - steps[0, 1] - y
    error[2] = pose[1, 2] - theta


@kept_on_disk
def _dot(a, b):
    total = 0.0
    for i in range(len(a)):
        total += a[i] * b[i]
    return total


@kept_on_disk
def _product(matrix, vector):
    out = np.empty_like(vector)
    for i in range(len(vector)):
        out[i] = _dot(matrix[i], vector)
    return out


@kept_on_disk
def _mirrors(jacobian):
    """Householder's unit vectors: reflected by one after the other, the null space is the last n - 3 axes."""
    rows = jacobian.copy()
    mirrors = np.zeros_like(rows)
    for k in range(3):
        mirrors[k, k:] = rows[k, k:]
        size = np.sqrt(_dot(mirrors[k], mirrors[k]))
        mirrors[k, k] += size if mirrors[k, k] >= 0 else -size
        size = np.sqrt(_dot(mirrors[k], mirrors[k]))
        if size > 0.0:
            mirrors[k] /= size
        for row in rows:
            row -= 2.0 * _dot(mirrors[k], row) * mirrors[k]
    return mirrors


@kept_on_disk
def _reflect(mirror, matrix):
    """Reflects a symmetric matrix on both sides, in place."""
    along = _product(matrix, mirror)
    along -= _dot(mirror, along) * mirror
    for i in range(len(mirror)):
        for j in range(len(mirror)):
            matrix[i, j] -= 2.0 * (mirror[i] * along[j] + along[i] * mirror[j])


@kept_on_disk
def _solve(matrix, rhs, safe, floor):
    """Solves `|matrix| x = rhs` in place of `rhs`, where |matrix| has its eigenvalues' sizes, at least `floor`.

    By Cholesky's factorisation; where a pivot is below `safe`, by eigenvectors: negative curvature is reflected.
    """
    factor, n = matrix.copy(), len(rhs)
    for j in range(n):
        for k in range(j):
            factor[j, j] -= factor[j, k] ** 2
        if factor[j, j] < safe:
            values, vectors = np.linalg.eigh(matrix)
            return _product(vectors, _product(vectors.T, rhs) / np.maximum(np.abs(values), floor))
        factor[j, j] = np.sqrt(factor[j, j])
        for i in range(j + 1, n):
            for k in range(j):
                factor[i, j] -= factor[i, k] * factor[j, k]
            factor[i, j] /= factor[j, j]
    for i in range(n):
        for k in range(i):
            rhs[i] -= factor[i, k] * rhs[k]
        rhs[i] /= factor[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            rhs[i] -= factor[k, i] * rhs[k]
        rhs[i] /= factor[i, i]
    return rhs
