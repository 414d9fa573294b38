"""Gaussian elimination in C, of one size."""

_SOLVE = """\
/* Solves m x = v, x in v's place, with partial pivoting; m is lost. Returns the smallest pivot. */
static double %(name)s(double m[%(size)s][%(size)s], double v[%(size)s])
{
    double least = HUGE_VAL;
    int i, j, k;
    for (k = 0; k < %(size)s; ++k) {
        int best = k;
        for (i = k + 1; i < %(size)s; ++i) {
            if (fabs(m[i][k]) > fabs(m[best][k])) {
                best = i;
            }
        }
        if (best != k) {
            for (j = k; j < %(size)s; ++j) {
                const double held = m[k][j];
                m[k][j] = m[best][j];
                m[best][j] = held;
            }
            {
                const double held = v[k];
                v[k] = v[best];
                v[best] = held;
            }
        }
        if (!(fabs(m[k][k]) > 0.0)) {
            return 0.0;
        }
        least = fmin(least, fabs(m[k][k]));
        for (i = k + 1; i < %(size)s; ++i) {
            const double factor = m[i][k] / m[k][k];
            for (j = k + 1; j < %(size)s; ++j) {
                m[i][j] -= factor * m[k][j];
            }
            v[i] -= factor * v[k];
        }
    }
    for (k = %(size)s - 1; k >= 0; --k) {
        for (j = k + 1; j < %(size)s; ++j) {
            v[k] -= m[k][j] * v[j];
        }
        v[k] /= m[k][k];
    }
    return least;
}

"""


def solve_text(name: str, size: str) -> str:
    """A function of that name, for matrices of that size."""
    return _SOLVE % {"name": name, "size": size}
