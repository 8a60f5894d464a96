"""The filter's compiled kernels in plain NumPy: each function has the name and the arguments of its kernel."""

import numpy as np


def rows(normals, offsets, period, end_maps, end_directions, columns, extra, sizes):
    """`halfspace_kernels.rows`."""
    n, ends = len(normals), len(period)
    a = normals[:, period]  # (n, E, d)
    gradient = np.einsum("ned,edz->nez", a, end_maps)
    spread = np.zeros((n, ends, sizes))
    along = np.abs(np.einsum("ned,edk->nek", a, end_directions))
    for end in range(ends):
        spread[:, end, columns[end]] = along[:, end]
        spread[:, end, extra[end]] = 1.0
    return gradient.reshape(n * ends, -1), spread.reshape(n * ends, -1), offsets[:, period].ravel()


def slack(normals, offsets, period, end_maps, end_directions, columns, extra, magnitudes, z):
    """`halfspace_kernels.slack`."""
    parts = normals, offsets, period, end_maps, end_directions, columns, extra
    gradient, spread, bound = rows(*parts, len(magnitudes))
    return bound - gradient @ z - spread @ magnitudes


def least(slack, most):
    """`halfspace_kernels.least`."""
    return np.append(slack, most).min()  # NaN if one value is


def presolve_rows(gradient, spread, bound, z_0, constant, M, center, radius, atoms, scale, tightening):
    """`halfspace_kernels.presolve_rows`."""
    f, t = gradient[:, len(z_0) :], spread @ M
    bound = bound - tightening - gradient[:, : len(z_0)] @ z_0 - spread @ constant
    least = f @ center - np.abs(f) @ radius + t @ atoms[0]
    most = f @ center + np.abs(f) @ radius + t @ atoms[1]
    A = np.hstack([f, t]) * scale
    length = np.maximum(np.linalg.norm(A, axis=1), tightening)
    if (least > bound).any():
        return -1, A[:0], bound[:0]
    chosen = most > bound
    return int(chosen.sum()), A[chosen] / length[chosen, None], (bound / length)[chosen]


def reachable(low, high, change, before):
    """`halfspace_kernels.reachable`."""
    least, most = np.maximum(before - change, low), np.minimum(before + change, high)
    return 0.5 * (least + most).ravel(), 0.5 * (most - least).ravel()


def filled_by_plans(W, W_free, M, m_0, position, position_free, directions, z, radius, beside, start, turn):
    """`halfspace_kernels.filled_by_plans`."""
    generators = directions.shape[2]
    sizes = M @ (np.abs(W @ z) + W_free @ radius) + m_0
    half = beside + sizes[generators:].max() + position_free @ radius + directions @ sizes[:generators]  # (N, d)
    half = half @ np.abs(turn).T
    middle = start + position @ z @ turn.T
    middle, half = np.vstack([start, middle]), np.vstack([half[0], half])
    return np.stack([middle - half, middle + half])


def within(values, bounds):
    """`tube_kernels.within`."""
    values = values[: bounds.shape[1]]
    return bool(((values >= bounds[0]) & (values <= bounds[1])).all())


def magnitudes(W_t, M_t, m_0, z):
    """`tube_kernels.magnitudes`."""
    return M_t.T @ np.abs(W_t.T @ z) + m_0


def places(position, z, start, turn):
    """`tube_kernels.places`."""
    return start + position @ z @ turn.T


def sets(W_t, M_t, m_0, position, directions, z, start, turn, measured):
    """`tube_kernels.sets`."""
    sizes = magnitudes(W_t, M_t, m_0, z)[: directions.shape[2]]
    return places(position, z, start, turn), measured + np.abs(turn @ directions) @ sizes


def extent(W_t, M_t, m_0, position, directions, z, body):
    """`tube_kernels.extent`."""
    sizes, generators = magnitudes(W_t, M_t, m_0, z), directions.shape[2]
    corner = np.abs(position @ z) + np.abs(directions) @ sizes[:generators]
    return np.linalg.norm(corner, axis=1).max() + body + sizes[generators:].max()


def next_state(C, W_t, M_t, kappa_t, w, widths, z, start, turn):
    """`tube_kernels.next_state`."""
    center = C @ z
    center[: len(start)] = start + turn @ center[: len(start)]
    return center, widths @ (magnitudes(W_t, M_t, w, z) + kappa_t.T @ np.abs(z))


def hildreth_active_set(h, g, A, b, steps):
    """`active_set_kernels.hildreth_active_set`."""
    x, multipliers, chosen = -g / h, np.zeros(len(b)), np.zeros(len(b), dtype=bool)
    length = (A * A / h).sum(axis=1)
    for _ in range(steps):
        step = np.maximum((A @ x - b) / length, -multipliers)
        gain = np.nan_to_num(step * step * length, nan=-1.0)
        best = int(gain.argmax())
        if gain[best] <= 1e-14:
            break
        chosen[best] = True
        multipliers[best] += step[best]
        x = x - step[best] * A[best] / h
    return chosen


def clip_to_bounds(wanted, before, low, high, slew):
    """`plan_inputs.clip_to_bounds`."""
    return np.minimum(np.maximum(wanted, np.maximum(low, before - slew)), np.minimum(high, before + slew))


def regressors_of_braking(z_0, braking, action):
    """`plan_inputs.regressors_of_braking`."""
    return np.concatenate([z_0, (braking * action).ravel()])
