"""The compiled time loop of family A: a discrete elastic rod in absolute node coordinates, stepped linearly implicitly.

Nodes 0..n, segments of equal rest length between them, a bending moment at every node. The two held nodes follow the
grippers; the moment there turns the first (last) segment, whose middle is half a segment away, towards the gripper's
angle. With g_j the gradient of the bend angle phi_j and t_i the direction of segment i, one step solves

    (M + dt sum_j B_j (dt + tau) g_j g_j' + dt sum_i k (dt + tau_a) t_i t_i' + dt C) v' = M v + dt (F_elastic + F_outer)

for the velocities v' at its end, banded with five sub-diagonals; C holds friction and drag, whose coefficient
mu w / sqrt(v^2 + v_0^2) is taken at the latest iterate of the velocity.
"""

from __future__ import annotations

import numba
import numpy as np

BAND = 6
REGULARISATION = 1e-4
"""Speed v_0 below which friction is viscous [m/s]."""

# Entries of the parameter vector; see `rod.parameters`.
(
    DAMPING, AXIAL, FRICTION, EXCESS, STRIBECK, DRAG, PULL_X, PULL_Y, LOAD,
    PATCH_X, PATCH_Y, PATCH_R, PATCH_MU, YIELD, HARDENING, RETURNED, RETURN_TIME,
    HYST_M, HYST_K, SLIP_GRIPPER, SLIP_TIME, SLIP_DISTANCE, OFFSET_0, OFFSET_1, GRASP_0, GRASP_1,
    OBSTACLE_X, OBSTACLE_Y, OBSTACLE_R, MAGNET_X, MAGNET_Y, MAGNET_A, MAGNET_R, DRIFT, DRIFT_TIME,
    ANISOTROPY, TETHER_NODE, TETHER_X, TETHER_Y, TETHER_K, TETHER_SLACK, SHAKE_X, SHAKE_Y, SHAKE_W,
    CREEP, CREEP_TIME, LUBRICATION, SIGNED, LENGTH,
) = range(49)  # fmt: skip
N_PARAMETERS = 49

AXIAL_DAMPING = 2e-3
OBSTACLE_STIFFNESS = 3000.0
OBSTACLE_FRICTION = 0.1
SLIP_DURATION = 0.3
"""Time scale of the sigmoid with which the cable slides through a gripper [s]."""


@numba.njit(cache=True, fastmath={"contract", "reassoc", "nsz", "arcp"}, error_model="numpy")
def _solve_banded(a, b, size):
    """Solves the symmetric positive definite banded system in place: a[i, k] is the entry (i, i - k)."""
    for i in range(size):
        low = max(0, i - BAND + 1)
        for j in range(low, i):
            total = a[i, i - j]
            for k in range(low, j):  # both rows have these entries: j - BAND + 1 <= low
                total -= a[i, i - k] * a[j, j - k]
            a[i, i - j] = total * a[j, 0]
        total, right = a[i, 0], b[i]
        for k in range(low, i):
            total -= a[i, i - k] * a[i, i - k]
            right -= a[i, i - k] * b[k]
        inverse = 1.0 / np.sqrt(total)
        a[i, 0] = inverse  # the inverse of the factor's diagonal
        b[i] = right * inverse
    for i in range(size - 1, -1, -1):
        b[i] *= a[i, 0]
        for k in range(max(0, i - BAND + 1), i):
            b[k] -= a[i, i - k] * b[i]


@numba.njit(cache=True, fastmath={"contract", "reassoc", "nsz", "arcp"}, error_model="numpy")
def _add(a, b, v, n, i, gx, gy, j, hx, hy, weight):
    """Adds weight * g_i h_j' to the matrix (lower half), or to the right side where j is a held node."""
    if i < 1 or i > n - 1:
        return
    row = 2 * (i - 1)
    if j < 1 or j > n - 1:
        along = weight * (hx * v[j, 0] + hy * v[j, 1])
        b[row] -= gx * along
        b[row + 1] -= gy * along
        return
    column = 2 * (j - 1)
    if row > column:
        a[row, row - column] += weight * gx * hx
        a[row, row - column - 1] += weight * gx * hy
        a[row + 1, row + 1 - column] += weight * gy * hx
        a[row + 1, row - column] += weight * gy * hy
    elif row == column:
        a[row, 0] += weight * gx * hx
        a[row + 1, 1] += weight * gy * hx
        a[row + 1, 0] += weight * gy * hy


@numba.njit(cache=True, fastmath={"contract", "reassoc", "nsz", "arcp"}, error_model="numpy")
def _diagonal(a, i, xx, xy, yy):
    row = 2 * (i - 1)
    a[row, 0] += xx
    a[row + 1, 1] += xy
    a[row + 1, 0] += yy


@numba.njit(cache=True, fastmath={"contract", "reassoc", "nsz", "arcp"}, error_model="numpy")
def advance(
    x, v, mass, stiffness, rest, state, grasp, p, pose, dt, substeps, settling, iterations, time, out, rest_out
):
    """Steps the rod along a path of gripper poses.

    Args:
        x, v: node positions and velocities [n + 1, 2]; changed in place.
        mass: of every node; stiffness, rest: EI and rest curvature at every node [n + 1].
        state: plastic, recoverable plastic, Bouc-Wen and Maxwell variable of every node [4, n + 1]; changed in place.
        grasp: yielded angle of each grasp [2]; changed in place.
        p: see the names above.
        pose: gripper poses at every frame, shape [F + 1, 2, 3]; the first one is where the rod is now.
        settling: rate of an extra damping of all motion; > 0 also means no friction and no memory effects.
        time: of the first frame.
        out, rest_out: node positions at every frame [F + 1, n + 1, 2] and the rest length of a segment [F + 1].
    """
    n = x.shape[0] - 1
    size = 2 * (n - 1)
    a, b = np.zeros((size, BAND)), np.zeros(size)
    a0, b0 = np.zeros((size, BAND)), np.zeros(size)
    phi, gradient = np.zeros(n + 1), np.zeros((n + 1, 3, 2))
    new = np.zeros_like(v)
    theta, omega = np.zeros(2), np.zeros(2)
    memory = settling == 0.0
    for frame in range(pose.shape[0] - 1):
        if frame == 0:
            out[0] = x
            rest_out[0] = p[LENGTH] / n
        for sub in range(substeps):
            # Grippers, and the length of cable between them.
            share = sub / substeps
            for q in range(2):
                node = 0 if q == 0 else n
                for c in range(2):
                    v[node, c] = (pose[frame + 1, q, c] - pose[frame, q, c]) / (substeps * dt)
                omega[q] = (pose[frame + 1, q, 2] - pose[frame, q, 2]) / (substeps * dt)
                theta[q] = pose[frame, q, 2] + share * (pose[frame + 1, q, 2] - pose[frame, q, 2])
            theta[0] += p[OFFSET_0] + grasp[0]
            theta[1] += p[OFFSET_1] + grasp[1]
            rest_length, growth = p[LENGTH] / n, 0.0
            if p[SLIP_DISTANCE] != 0.0 and memory:
                slid = 1.0 / (1.0 + np.exp(-(time - p[SLIP_TIME]) / SLIP_DURATION))
                rest_length += p[SLIP_DISTANCE] * slid / n
                growth = p[SLIP_DISTANCE] * slid * (1.0 - slid) / (SLIP_DURATION * n)
            warm = 1.0
            if memory:
                warm = 1.0 + p[DRIFT] * (1.0 - np.exp(-time / p[DRIFT_TIME]))

            a0[:], b0[:] = 0.0, 0.0
            for i in range(1, n):
                row = 2 * (i - 1)
                m = mass[i]
                a0[row, 0] = m * (1.0 + dt * settling)
                a0[row + 1, 0] = m * (1.0 + dt * settling)
                b0[row] = m * v[i, 0] + dt * m * p[PULL_X]
                b0[row + 1] = m * v[i, 1] + dt * m * p[PULL_Y]

            # Stretch.
            k = p[AXIAL] / rest_length
            for i in range(n):
                dx, dy = x[i + 1, 0] - x[i, 0], x[i + 1, 1] - x[i, 1]
                long = np.sqrt(dx * dx + dy * dy)
                tx, ty = dx / long, dy / long
                tension = k * (long - rest_length)
                inside = i > 0, i + 1 < n
                if inside[0]:
                    b0[2 * i - 2] += dt * tension * tx
                    b0[2 * i - 1] += dt * tension * ty
                if inside[1]:
                    b0[2 * i] -= dt * tension * tx
                    b0[2 * i + 1] -= dt * tension * ty
                weight = dt * (dt + AXIAL_DAMPING) * k
                across = dt * dt * tension / long if tension > 0.0 else 0.0
                if 0 < i < n - 1:
                    xx, xy, yy = weight * tx * tx + across * ty * ty, (weight - across) * tx * ty, 0.0
                    yy = weight * ty * ty + across * tx * tx
                    row = 2 * (i - 1)
                    a0[row, 0] += xx
                    a0[row + 1, 1] += xy
                    a0[row + 1, 0] += yy
                    a0[row + 2, 0] += xx
                    a0[row + 3, 1] += xy
                    a0[row + 3, 0] += yy
                    a0[row + 2, 2] -= xx
                    a0[row + 3, 3] -= xy
                    a0[row + 2, 1] -= xy
                    a0[row + 3, 2] -= yy
                else:
                    for c in range(2):
                        for d in range(2):
                            sign = 1.0 if c == d else -1.0
                            _add(a0, b0, v, n, i + c, tx, ty, i + d, tx, ty, sign * weight)
                            _add(a0, b0, v, n, i + c, -ty, tx, i + d, -ty, tx, sign * across)

            # Bending.
            for j in range(n + 1):
                cell = rest_length if 0 < j < n else 0.5 * rest_length
                if j > 0:
                    ax, ay = x[j, 0] - x[j - 1, 0], x[j, 1] - x[j - 1, 1]
                else:
                    ax, ay = np.cos(theta[0]), np.sin(theta[0])
                if j < n:
                    bx, by = x[j + 1, 0] - x[j, 0], x[j + 1, 1] - x[j, 1]
                else:
                    bx, by = np.cos(theta[1]), np.sin(theta[1])
                phi[j] = np.arctan2(ax * by - ay * bx, ax * bx + ay * by)
                gradient[j] = 0.0
                if j > 0:
                    square = ax * ax + ay * ay
                    gradient[j, 0, 0] += -ay / square
                    gradient[j, 0, 1] += ax / square
                if j < n:
                    square = bx * bx + by * by
                    gradient[j, 2, 0] += -by / square
                    gradient[j, 2, 1] += bx / square
                gradient[j, 1, 0] = -gradient[j, 0, 0] - gradient[j, 2, 0]
                gradient[j, 1, 1] = -gradient[j, 0, 1] - gradient[j, 2, 1]
                turning = -omega[0] if j == 0 else (omega[1] if j == n else 0.0)
                kappa = phi[j] / cell
                bending = stiffness[j] * warm
                if p[SIGNED] != 0.0:
                    bending *= 1.0 + p[SIGNED] * np.tanh(kappa)
                moment = bending * (kappa - rest[j] - state[0, j] - state[1, j])
                slope = bending * (dt + p[DAMPING]) / cell
                if memory and p[CREEP] > 0.0:
                    moment += p[CREEP] * bending * (kappa - state[3, j])
                    slope += p[CREEP] * bending * dt / cell
                if memory and p[HYST_M] > 0.0:
                    z = state[2, j]
                    before = 0.0
                    for c in range(3):
                        if 0 <= j - 1 + c <= n:
                            before += gradient[j, c, 0] * v[j - 1 + c, 0] + gradient[j, c, 1] * v[j - 1 + c, 1]
                    before += turning
                    sign = 1.0 if before * z >= 0.0 else -1.0
                    rate = max(0.0, 1.0 - np.abs(z) ** 1.5 * (0.65 * sign + 0.35)) / p[HYST_K]
                    moment += p[HYST_M] * z
                    slope += p[HYST_M] * rate * dt / cell
                weight = dt * slope
                push = dt * moment + weight * turning
                for c in range(3):
                    i = j - 1 + c
                    if 1 <= i <= n - 1:
                        b0[2 * i - 2] -= push * gradient[j, c, 0]
                        b0[2 * i - 1] -= push * gradient[j, c, 1]
                if 2 <= j <= n - 2:
                    row = 2 * (j - 2)
                    for r in range(BAND):
                        scaled = weight * gradient[j, r // 2, r % 2]
                        for c in range(r + 1):
                            a0[row + r, r - c] += scaled * gradient[j, c // 2, c % 2]
                else:
                    for c in range(3):
                        for d in range(3):
                            i, other = j - 1 + c, j - 1 + d
                            if 0 <= i <= n and 0 <= other <= n:
                                _add(a0, b0, v, n, i, gradient[j, c, 0], gradient[j, c, 1],
                                     other, gradient[j, d, 0], gradient[j, d, 1], weight)  # fmt: skip

            # Things other than the cable.
            if p[OBSTACLE_R] > 0.0 and memory:
                for i in range(n):
                    for part in range(4):
                        share_b = (part + 0.5) / 4
                        cx = x[i, 0] + share_b * (x[i + 1, 0] - x[i, 0]) - p[OBSTACLE_X]
                        cy = x[i, 1] + share_b * (x[i + 1, 1] - x[i, 1]) - p[OBSTACLE_Y]
                        far = np.sqrt(cx * cx + cy * cy)
                        depth = p[OBSTACLE_R] - far
                        if depth > 0.0:
                            nx, ny = cx / far, cy / far
                            soft = min(1.0, depth / 3e-4)
                            normal = OBSTACLE_STIFFNESS / 4 * depth * soft
                            hard = OBSTACLE_STIFFNESS / 4 * min(1.0, 2 * depth / 3e-4)
                            for c in range(2):
                                i_c, w_c = i + c, (share_b if c == 1 else 1.0 - share_b)
                                if 1 <= i_c <= n - 1:
                                    b0[2 * i_c - 2] += dt * normal * nx * w_c
                                    b0[2 * i_c - 1] += dt * normal * ny * w_c
                                    speed = -v[i_c, 0] * ny + v[i_c, 1] * nx
                                    rub = dt * w_c * OBSTACLE_FRICTION * normal / np.sqrt(speed * speed + 1e-6)
                                    h = dt * dt * hard * w_c
                                    _diagonal(a0, i_c, h * nx * nx + rub * ny * ny,
                                              (h - rub) * nx * ny, h * ny * ny + rub * nx * nx)  # fmt: skip
            if p[MAGNET_A] != 0.0:
                for i in range(1, n):
                    dx, dy = p[MAGNET_X] - x[i, 0], p[MAGNET_Y] - x[i, 1]
                    near = (dx * dx + dy * dy) / p[MAGNET_R] ** 2
                    pull = dt * p[MAGNET_A] * rest_length / p[MAGNET_R] / (1.0 + near) ** 2
                    b0[2 * i - 2] += pull * dx
                    b0[2 * i - 1] += pull * dy
            if p[TETHER_K] > 0.0:
                i = int(p[TETHER_NODE])
                dx, dy = p[TETHER_X] - x[i, 0], p[TETHER_Y] - x[i, 1]
                far = np.sqrt(dx * dx + dy * dy)
                if far > p[TETHER_SLACK]:
                    pull = p[TETHER_K] * (far - p[TETHER_SLACK]) / far
                    b0[2 * i - 2] += dt * pull * dx
                    b0[2 * i - 1] += dt * pull * dy
                    _diagonal(a0, i, dt * dt * p[TETHER_K], 0.0, dt * dt * p[TETHER_K])

            # The table, whose friction depends on the velocity that is sought.
            new[:] = v
            table_x = p[SHAKE_X] * p[SHAKE_W] * np.cos(p[SHAKE_W] * time) if memory else 0.0
            table_y = p[SHAKE_Y] * p[SHAKE_W] * np.cos(p[SHAKE_W] * time) if memory else 0.0
            for _ in range(iterations if memory else 1):
                a[:], b[:] = a0, b0
                if memory:
                    for i in range(1, n):
                        mu = p[FRICTION]
                        if p[PATCH_R] > 0.0:
                            far = np.sqrt((x[i, 0] - p[PATCH_X]) ** 2 + (x[i, 1] - p[PATCH_Y]) ** 2)
                            mu += (p[PATCH_MU] - mu) * 0.5 * (1.0 - np.tanh((far - p[PATCH_R]) / (p[PATCH_R] / 8)))
                        ux, uy = table_x, table_y
                        if growth != 0.0:
                            # Nodes are spread evenly over the free length, so they move along the cable as it slides.
                            moved = i * growth if p[SLIP_GRIPPER] > 0.5 else -(n - i) * growth
                            dx, dy = x[i + 1, 0] - x[i - 1, 0], x[i + 1, 1] - x[i - 1, 1]
                            far = np.sqrt(dx * dx + dy * dy)
                            ux += moved * dx / far
                            uy += moved * dy / far
                        wx, wy = new[i, 0] - ux, new[i, 1] - uy
                        speed = np.sqrt(wx * wx + wy * wy)
                        if p[EXCESS] > 0.0:
                            mu *= 1.0 + p[EXCESS] * np.exp(-((speed / p[STRIBECK]) ** 2))
                        if p[LUBRICATION] > 0.0:
                            mu *= 1.0 + (speed / p[LUBRICATION]) ** 2
                        rub = mu * mass[i] * p[LOAD] / np.sqrt(speed * speed + REGULARISATION**2)
                        cx = dt * (rub + p[DRAG] * rest_length)
                        cy = dt * (rub * (1.0 + p[ANISOTROPY]) + p[DRAG] * rest_length)
                        _diagonal(a, i, cx, 0.0, cy)
                        b[2 * i - 2] += cx * ux
                        b[2 * i - 1] += cy * uy
                _solve_banded(a, b, size)
                for i in range(1, n):
                    new[i, 0], new[i, 1] = b[2 * i - 2], b[2 * i - 1]

            # Memory of the bends.
            if memory:
                for j in range(n + 1):
                    cell = rest_length if 0 < j < n else 0.5 * rest_length
                    rate = -omega[0] if j == 0 else (omega[1] if j == n else 0.0)
                    for c in range(3):
                        if 0 <= j - 1 + c <= n:
                            rate += gradient[j, c, 0] * new[j - 1 + c, 0] + gradient[j, c, 1] * new[j - 1 + c, 1]
                    kappa = (phi[j] + dt * rate) / cell
                    if p[YIELD] < 1e8:
                        state[1, j] -= dt / p[RETURN_TIME] * state[1, j]
                        flowed = state[0, j] + state[1, j]
                        over = kappa - rest[j] - (1.0 + p[HARDENING]) * flowed
                        if np.abs(over) > p[YIELD]:
                            step = (over - np.sign(over) * p[YIELD]) / (1.0 + p[HARDENING])
                            state[0, j] += (1.0 - p[RETURNED]) * step
                            state[1, j] += p[RETURNED] * step
                    if p[HYST_M] > 0.0:
                        z = state[2, j]
                        sign = 1.0 if rate * z >= 0.0 else -1.0
                        growth_z = max(0.0, 1.0 - np.abs(z) ** 1.5 * (0.65 * sign + 0.35)) / p[HYST_K]
                        state[2, j] = min(1.0, max(-1.0, z + growth_z * dt * rate / cell))
                    if p[CREEP] > 0.0:
                        state[3, j] += dt / p[CREEP_TIME] * (kappa - state[3, j])
            # Grasps that yield: the clamp's own bending stiffness in series with a damped spring.
            for q in range(2):
                k_g = p[GRASP_0] if q == 0 else p[GRASP_1]
                if k_g > 0.0:
                    j = 0 if q == 0 else n
                    clamp = 2.0 * stiffness[j] * warm / rest_length
                    lean = phi[j] + grasp[0] if q == 0 else grasp[1] - phi[j]
                    lean -= (0.5 * rest_length) * rest[j] * (1.0 if q == 0 else -1.0)
                    damper = 0.05 * k_g / dt
                    grasp[q] = (damper * grasp[q] + clamp * lean) / (damper + k_g + clamp)
            v[1:n] = new[1:n]
            for i in range(n + 1):
                x[i, 0] += dt * v[i, 0]
                x[i, 1] += dt * v[i, 1]
            time += dt
        # The held nodes are where the grippers are, to the last digit.
        x[0, 0], x[0, 1] = pose[frame + 1, 0, 0], pose[frame + 1, 0, 1]
        x[n, 0], x[n, 1] = pose[frame + 1, 1, 0], pose[frame + 1, 1, 1]
        out[frame + 1] = x
        rest_out[frame + 1] = rest_length
    return time
