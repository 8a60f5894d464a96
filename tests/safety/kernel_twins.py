"""The filter's compiled kernels in plain NumPy: each function has the name and the arguments of its kernel."""

from itertools import pairwise

import numpy as np

from brakeline.messaging.obstacle import LARGEST, ORTHONORMAL, Shapes
from brakeline.safety.filter.batch.dual_active_set import solve_batch
from brakeline.safety.filter.halfspaces import TOUCHING


def rows(normals, offsets, position, offset, stretch, end, period, end_directions, columns, extra, sizes, widening):
    """`halfspace_kernels.rows`."""
    n, ends = len(normals), len(period)
    a = normals[:, period]  # (n, E, d)
    end_maps, end_offset = (np.concatenate([np.zeros((1, *m.shape[1:])), m])[end] for m in (position, offset))
    factor = np.append(0.0, stretch if len(stretch) else np.ones(len(position)))[end]
    gradient = np.einsum("ned,edz->nez", a, end_maps)
    spread = np.zeros((n, ends, sizes))
    along = np.abs(np.einsum("ned,edk->nek", a, end_directions)) * factor[:, None]
    for e in range(ends):
        spread[:, e, columns[e]] = along[:, e]
        spread[:, e, extra[e]] = 1.0
    bound = offsets[:, period] - np.einsum("ned,ed->ne", a, end_offset)
    return gradient.reshape(n * ends, -1), widening * spread.reshape(n * ends, -1), bound.ravel()


def slack(normals, offsets, position, offset, stretch, end, period, end_directions, columns, extra, magnitudes, z):
    """`halfspace_kernels.slack`."""
    parts = normals, offsets, position, offset, stretch, end, period, end_directions, columns, extra
    gradient, spread, bound = rows(*parts, len(magnitudes), 1.0)
    return bound - gradient @ z - spread @ magnitudes


def least(slack, most):
    """`halfspace_kernels.least`."""
    return np.append(slack, most).min()  # NaN if one value is


def row_slack(gradient, spread, bound, z, sizes):
    """`qp_kernels.row_slack`."""
    return bound - gradient @ z - spread @ sizes


def tightened(gradient, spread, bound, kept_off, too_near, translating, stay, room):
    """`qp_kernels.tightened`."""
    closer = gradient[too_near] * translating
    slopes, spreads = np.vstack([gradient, closer]), np.vstack([spread, 0.0 * spread[too_near]])
    return slopes, spreads, np.concatenate([np.where(too_near, bound, bound - kept_off), closer @ stay + room])


def atom_range(W_known, W_f, z_0, center, radius):
    """`qp_kernels.atom_range`."""
    atom, deviation = np.abs(W_known @ z_0 + W_f @ center), np.abs(W_f) @ radius
    return np.stack([np.maximum(atom - deviation, 0.0), atom + deviation])


def presolved_rows(
    gradient, spread, bound, z_0, constant, M, center, radius, atoms, scale, tightening, fixed, fixed_bound, fixed_slope
):
    """`qp_kernels.presolved_rows`."""
    f, t = gradient[:, len(z_0) :], spread @ M
    bound = bound - tightening - gradient[:, : len(z_0)] @ z_0 - spread @ constant
    least = f @ center - np.abs(f) @ radius + t @ atoms[0]
    most = f @ center + np.abs(f) @ radius + t @ atoms[1]
    A = np.hstack([f, t]) * scale
    length = np.maximum(np.linalg.norm(A, axis=1), tightening)
    if (least > bound).any():
        return -1, A[:0], bound[:0]
    chosen = most > bound
    A, b = np.vstack([A[chosen] / length[chosen, None], fixed]), (bound / length)[chosen]
    return len(A), A, np.concatenate([b, fixed_bound + fixed_slope @ z_0])


def reachable(low, high, change, before):
    """`qp_kernels.reachable`."""
    least, most = np.maximum(before - change, low), np.minimum(before + change, high)
    return 0.5 * (least + most).ravel(), 0.5 * (most - least).ravel()


def filled_by_plans(
    W, W_free, M, m_0, position, offset, position_free, directions, widening, z, radius, beside, start, turn
):
    """`halfspace_kernels.filled_by_plans`."""
    generators = directions.shape[2]
    sizes = widening * (M @ (np.abs(W @ z) + W_free @ radius) + m_0)
    half = beside + sizes[generators:].max() + position_free @ radius + directions @ sizes[:generators]  # (N, d)
    half = half @ np.abs(turn).T
    middle = start + (position @ z + offset) @ turn.T
    middle, half = np.vstack([start, middle]), np.vstack([half[0], half])
    return np.stack([middle - half, middle + half])


def within(values, bounds):
    """`tube_kernels.within`."""
    values = values[: bounds.shape[1]]
    return bool(((values >= bounds[0]) & (values <= bounds[1])).all())


def magnitudes(W_t, M_t, m_0, z):
    """`tube_kernels.magnitudes`."""
    return M_t.T @ np.abs(W_t.T @ z) + m_0


def places(position, offset, z, start, turn):
    """`tube_kernels.places`."""
    return start + (position @ z + offset) @ turn.T


def sets(W_t, M_t, m_0, position, offset, directions, widening, z, start, turn, measured):
    """`tube_kernels.sets`."""
    sizes = widening * magnitudes(W_t, M_t, m_0, z)[: directions.shape[2]]
    return places(position, offset, z, start, turn), measured + np.abs(turn @ directions) @ sizes


def extent(W_t, M_t, m_0, position, offset, directions, widening, z, body):
    """`tube_kernels.extent`."""
    sizes, generators = widening * magnitudes(W_t, M_t, m_0, z), directions.shape[2]
    corner = np.abs(position @ z + offset) + np.abs(directions) @ sizes[:generators]
    return np.linalg.norm(corner, axis=1).max() + body + sizes[generators:].max()


def next_state(C, W_t, M_t, kappa_t, w, widths, z, first, widening, start, turn):
    """`tube_kernels.next_state`."""
    center = first + C @ z
    center[: len(start)] = start + turn @ center[: len(start)]
    return center, widening * (widths @ (magnitudes(W_t, M_t, w, z) + kappa_t.T @ np.abs(z)))


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


def likely_rows(h, g, A, b, always, steps):
    """`active_set_kernels.likely_rows`."""
    index = np.flatnonzero(hildreth_active_set(h, g, A, b, steps) | (np.arange(len(b)) >= len(b) - always))
    return index, A[index], b[index]


def carrying_rows(multiplier, index, least):
    """`active_set_kernels.carrying_rows`."""
    return np.array(
        [index[i] for i in sorted(range(len(index)), key=lambda i: -multiplier[i]) if multiplier[i] > least]
    )


def exact_solution(h, g, A, b, guess):
    """`active_set_kernels.exact_solution`, by the method for many problems at once, and without a guess."""
    nothing = np.zeros((0, 1), dtype=int)
    found = solve_batch(np, h[:, None], g[:, None], A[..., None], b[:, None], nothing)
    return found.x[:, 0] if found.solved[0] else np.full(len(h), np.nan), bool(found.infeasible[0])


def clip_to_bounds(wanted, before, low, high, slew):
    """`plan_inputs.clip_to_bounds`."""
    return np.minimum(np.maximum(wanted, np.maximum(low, before - slew)), np.minimum(high, before + slew))


def regressors_of_braking(z_0, braking, action):
    """`plan_inputs.regressors_of_braking`."""
    return np.concatenate([z_0, (braking * action).ravel()])


def rollout(predictor, across, weight, window):
    """`rollout_kernels.rollout`."""
    outputs, factors = rollouts(predictor, across.T, weight, window[None], 0)
    return outputs[0], factors[0]


def turning(angle, d):
    """Return the rotation (d, d) about the vertical axis."""
    turn = np.eye(d)
    turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    return turn


def features(predictor, window):
    """Yield the features of each period, which starts with the speeds that follow from the period before."""
    C, scale, saturations, terms, others, _, _, _, inputs = predictor
    speeds, plan = window[: len(others)], window[len(others) :].reshape(-1, inputs)
    for before, u in pairwise(plan):
        v = np.concatenate([speeds, u, before])
        bent = [np.tanh((v[int(a)] - (v[int(b)] if b >= 0 else 0.0)) / width) for a, b, width in saturations]
        phi = np.concatenate([[1.0], v / scale, bent])[terms].prod(axis=1)
        yield phi
        speeds = (C @ phi)[others]


def outputs_of(predictor, z):
    """Return the outputs (T, N, n + D·d) of windows z (T, r + m + N·m)."""
    C, _, _, _, _, heading, arms, d, _ = predictor
    outputs = []
    for window in z:
        p, angle, rows = np.zeros(d), 0.0, []
        for phi in features(predictor, window):
            row = C @ phi
            p = p + turning(angle, d) @ row[:d]
            row[:d] = p
            if heading >= 0:
                angle += row[heading]
                row[heading] = angle
            rows.append(np.concatenate([row, *(p + turning(angle, d) @ arm - arm for arm in arms)]))
        outputs.append(rows)
    return np.array(outputs)


def rollouts(predictor, root, weight, z, first):
    """`window_rollout_kernels.rollouts`."""
    sums = np.array([np.cumsum(list(features(predictor, window)), axis=0) for window in z])  # (T, N, terms)
    spread = ((sums @ np.tril(root).T) ** 2).sum(axis=2)
    factors = np.sqrt(1.0 + weight * spread / np.arange(1, sums.shape[1] + 1))
    factors[:, :first] = 1.0
    return outputs_of(predictor, z), factors


def linearized(predictor, z, T):
    """`rollout_kernels.linearized`: the gradient by central differences."""
    step = 1e-6
    ends = [outputs_of(predictor, z + sign * step * T.T) for sign in (1.0, -1.0)]
    gradient = (ends[0] - ends[1]) / (2.0 * step)
    return outputs_of(predictor, z[None])[0], np.moveaxis(gradient, 0, -1)


def affine(predictor, z, T, kept):
    """`rollout_kernels.affine`."""
    outputs, gradient = linearized(predictor, T @ z, T)
    offset, d = outputs - gradient @ z, predictor[7]
    return gradient[:, :d], offset[:, :d], gradient[:, kept], offset[:, kept]


def sets_around(predictor, across, weight, T, kept, sets, more_sets, z):
    """`rollout_kernels.sets_around`."""
    window, n, d = (T @ z)[None], len(predictor[0]), predictor[7]
    outputs, stretch = rollout(predictor, across, weight, window[0])
    wide, more_wide = (stretch[:, None, None] * part for part in (sets, more_sets))
    return outputs[:, :d], wide, outputs[:, kept], more_wide, outputs[0, :n], stretch


def score(predictor, across, weight, states, executed, W, M, kappa, w, scored):
    """`window_kernels.score`."""
    _, _, _, _, others, heading, arms, d, _ = predictor
    window, after = np.concatenate([states[0, others], executed.ravel()]), states[1:].copy()
    after[:, :d] = (states[1:, :d] - states[0, :d]) @ turning(states[0, heading], d)
    after[:, heading] = np.angle(np.exp(1j * (states[1:, heading] - states[0, heading])))
    turns = [turning(angle, d) for angle in after[:, heading]]
    discs = [[row[:d] + turn @ arm - arm for row, turn in zip(after, turns, strict=True)] for arm in arms]
    after = np.hstack([after, *discs])
    widths = M @ np.abs(W @ window) + kappa @ np.abs(window) + w
    predicted, stretch = rollout(predictor, across, weight, window)
    shares = np.abs(after - predicted) / (widths * stretch[:, None])
    of_scored = shares[:, scored].max()
    return max(of_scored, shares[0].max()), of_scored


def distances(center, axes, half, rho, rounded, point):
    """`shape_kernels.distances`."""
    return Shapes(center, axes, half, rho, rounded, np.zeros(len(rho))).distance(point)


def plausible(center, axes, half, rho, rounded, margin):
    """`shape_kernels.plausible`."""
    large = [np.abs(part).max(initial=0.0, where=~np.isnan(part)) > LARGEST for part in (center, half, rho, margin)]
    small = [(part < 0.0).any() for part in (half, rho)]
    with np.errstate(over="ignore", invalid="ignore"):
        off = axes.transpose(0, 2, 1) @ axes - np.eye(axes.shape[1])
    odd = ~np.isnan(rounded) & (rounded != 0.0) & (rounded != 1.0)
    return not (any(large) or any(small) or odd.any() or (np.abs(off) > ORTHONORMAL).any())


def parted(away, beyond, reach):
    """`shape_kernels.parted`."""
    counts = ~(away > reach)
    return float(away[~counts].min(initial=beyond)), counts, int(counts.sum())


def roomiest_planes(unit, level, ends):
    """`shape_kernels.roomiest_planes`."""
    number = np.arange(len(ends) - 1)[:, None]
    places, periods = 2 * number + np.arange(3), number
    along = unit @ ends.T  # (n, 2N+1, N+1)
    room = level[:, places] - np.maximum(along[:, places, periods], along[:, places, periods + 1])  # (n, N, 3)
    choice = 2 * periods[:, 0] + room.argmax(axis=2)
    through = np.logical_or.accumulate(~(room.max(axis=2) > 0.0), axis=1)
    before = (~through).sum(axis=1)  # periods until then
    last = np.where(before > 0, choice[np.arange(len(choice)), before - 1], 0)
    return np.where(through, last[:, None], choice)


def planes_beside(center, axes, half, rho, rounded, margin, start, nominal, keep_off, measured):
    """`shape_kernels.planes_beside`."""
    between = np.concatenate([np.zeros((1, nominal.shape[1])), nominal - start])
    seen_from = np.empty((2 * len(nominal) + 1, nominal.shape[1]))  # relative to the start
    seen_from[::2] = between
    seen_from[1::2] = 0.5 * (between[1:] + between[:-1])
    towards = Shapes(center, axes, half, rho, rounded, margin).towards(start + seen_from)  # (n, 2N+1, d)
    gap = np.sqrt(np.einsum("nqd,nqd->nq", towards, towards))
    unit = towards / np.maximum(gap, TOUCHING)[..., None]
    level = np.einsum("nqd,nqd->nq", unit, towards + seen_from)
    inside = ~(gap > TOUCHING)  # true for NaN, too
    level[inside | inside[:, :1]] = -np.inf
    choice = roomiest_planes(unit, level, between)
    each = np.arange(len(choice))[:, None]
    normal = unit[each, choice]
    return normal, level[each, choice] - np.maximum(keep_off + margin, 0.0)[:, None] - np.abs(normal) @ measured
