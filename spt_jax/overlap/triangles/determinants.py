"""Determinants of two or three differences of points: to rounding, with twice the digits, exact."""

import numpy as np

# Rounding of a determinant of three differences, against the product of their largest entries: six
# products of three factors, each factor rounded once, with two roundings a product and at most five
# in the sums. Twice that, so that nobody has to count again.
BOUND = 128 * 2.0**-53
# With twice the digits each operation loses a few units of 2^-106.
_DOUBLED = 2.0**-97
# Products below this may have lost bits to underflow.
LEAST = 2.0**-900
# Determinants of whole numbers below 2^34 are below 2^105, and so is all that is added up for them:
# with twice the digits they are exact. Coordinates that came in float32 are such numbers.
_EXACT_BITS = 34
# Cubes of smaller units would lose bits to underflow; of a zero.
_LEAST_UNIT, _NO_UNIT = -300, 2048


def determinant(u, v, w=None):
    """Of two columns of two numbers, or three of three, to rounding."""
    if w is None:
        return u[0] * v[1] - u[1] * v[0]
    return (
        (u[1] * v[2] - u[2] * v[1]) * w[0]
        + (u[2] * v[0] - u[0] * v[2]) * w[1]
        + (u[0] * v[1] - u[1] * v[0]) * w[2]
    )


def derivative(edges, turns):
    """How fast determinants change while their columns move, and what rounding may add to that.

    Args:
        edges: the columns, two or three.
        turns: how fast each of them moves.
    """
    size, speed = ([largest_of(x) for x in of] for of in (edges, turns))
    if len(edges) == 2:
        (u, v), (du, dv) = edges, turns
        value = determinant(du, v) + determinant(u, dv)
        return value, BOUND * (speed[0] * size[1] + size[0] * speed[1]) + LEAST
    (u, v, w), (du, dv, dw) = edges, turns
    value = np.zeros(u.shape[1:])
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        minor = (du[i] * v[j] - du[j] * v[i]) + (u[i] * dv[j] - u[j] * dv[i])
        value = value + (minor * w[k] + (u[i] * v[j] - u[j] * v[i]) * dw[k])
    bound = (speed[0] * size[1] + size[0] * speed[1]) * size[2] + size[0] * size[1] * speed[2]
    return value, BOUND * bound + LEAST


def permanent(u, v, w=None):
    """The sum of the sizes of a determinant's products."""
    u, v = np.abs(u), np.abs(v)
    if w is None:
        return u[0] * v[1] + u[1] * v[0]
    w = np.abs(w)
    return (
        (u[1] * v[2] + u[2] * v[1]) * w[0]
        + (u[2] * v[0] + u[0] * v[2]) * w[1]
        + (u[0] * v[1] + u[1] * v[0]) * w[2]
    )


def vanishes(*factors):
    """Whether each product in the determinants has a factor of zero."""
    return permanent(*((x != 0).astype(np.float64) for x in factors)) == 0


def doubled_determinants(rows, unit):
    """Determinants of the differences to the first row, in doubled digits, and which are certain.

    Args:
        rows: the points, (3, N) or (2, N) each.
        unit: exponents of two; all coordinates of the points are whole multiples of these powers.
    """
    edges = [_difference(x, rows[0]) for x in rows[1:]]
    terms = []
    if len(edges) == 2:
        (u, v) = edges
        terms = [_times(_at(u, 0), _at(v, 1)), _times(_at(u, 1), _minus(_at(v, 0)))]
    else:
        u, v, w = edges
        for k in range(3):
            i, j = (k + 1) % 3, (k + 2) % 3
            minor = _plus(_times(_at(u, i), _at(v, j)), _times(_at(u, j), _minus(_at(v, i))))
            terms.append(_times(minor, _at(w, k)))
    total = terms[0]
    for term in terms[1:]:
        total = _plus(total, term)
    value = total[0] + total[1]
    plain = [edge[0] for edge in edges]
    longest = np.maximum.reduce([np.abs(x).max(axis=0) for x in plain])
    exact = np.frexp(longest)[1] - unit <= _EXACT_BITS
    exact &= unit > _LEAST_UNIT
    return value, exact | (np.abs(value) > _DOUBLED * permanent(*plain) + LEAST)


def units(points):
    """Exponents of the largest powers of two of which all coordinates of a point are multiples."""
    mantissa, exponent = np.frexp(points)
    whole = np.ldexp(mantissa, 53).astype(np.int64)
    lowest = np.frexp((whole & -whole).astype(np.float64))[1] + exponent - 54
    return np.where(whole != 0, lowest, _NO_UNIT).min(axis=0)


def _at(pair, k):
    return pair[0][k], pair[1][k]


def _minus(x):
    return -x[0], -x[1]


def _sum(a, b):
    """A sum and what rounding took from it (Knuth)."""
    total = a + b
    of_b = total - a
    return total, (a - (total - of_b)) + (b - of_b)


def _difference(a, b):
    return _sum(a, -b)


def _product(a, b):
    """A product and what rounding took from it (Dekker)."""
    total = a * b
    (high_a, low_a), (high_b, low_b) = _halves(a), _halves(b)
    rest = high_a * high_b - total
    rest += high_a * low_b
    rest += low_a * high_b
    rest += low_a * low_b
    return total, rest


def _halves(a):
    scaled = 134217729.0 * a  # 2^27 + 1
    high = scaled - (scaled - a)
    return high, a - high


def _plus(x, y):
    total, rest = _sum(x[0], y[0])
    return _sum(total, rest + (x[1] + y[1]))


def _times(x, y):
    total, rest = _product(x[0], y[0])
    return _sum(total, rest + (x[0] * y[1] + x[1] * y[0]))


def whole_determinants(rows):
    """Determinants of the differences to the first row, exact and then rounded."""
    whole, exponent = _whole(rows)
    found = determinant(*(x - whole[0] for x in whole[1:]))
    return _rounded(found, len(rows[1:]) * exponent)


def whole_coefficient(rows, moves, order):
    """The coefficient of eps^order of the determinants, exact but for a positive factor."""
    whole, _ = _whole(rows)
    push, _ = _whole(moves)
    edges, turns = ([x - of[0] for x in of[1:]] for of in (whole, push))
    total: np.ndarray = np.zeros(rows[0].shape[1], object)
    for moved in range(1, 1 << len(edges)):
        if moved.bit_count() == order:
            part = [turns[k] if moved >> k & 1 else edges[k] for k in range(len(edges))]
            total = total + determinant(*part)
    return np.array([(x > 0) - (x < 0) for x in total.tolist()], float)


def _whole(rows):
    """Numbers as Python's whole ones, in units of two to one exponent."""
    mantissa, exponent = np.frexp(np.stack(rows))
    mantissa = np.ldexp(mantissa, 53).astype(np.int64)
    exponent = np.where(mantissa != 0, exponent - 53, np.iinfo(np.int32).max)
    least = int(exponent.min(initial=0))
    shift = np.where(mantissa != 0, exponent - least, 0)
    whole = np.empty(mantissa.shape, object)
    whole.ravel()[:] = [
        m << s for m, s in zip(mantissa.ravel().tolist(), shift.ravel().tolist(), strict=True)
    ]
    return list(whole), least


def _rounded(whole, exponent: int):
    found = np.empty(len(whole))
    for k, x in enumerate(whole.tolist()):
        cut = max(abs(x).bit_length() - 62, 0)
        found[k] = np.ldexp(float(x >> cut), cut + exponent)
        if x and not found[k]:
            found[k] = np.copysign(np.finfo(float).smallest_subnormal, x)
    return found


def largest_of(x):
    """The largest size of a coordinate, of each point."""
    size = np.abs(x)
    return np.maximum.reduce(size, axis=0)
