"""The chi-squared distribution of a whole number of degrees of freedom, in its closed form: SciPy's waits to load."""

from math import erfc, exp, pi, sqrt


def chance_above(freedom: int, value: float) -> float:
    """How likely a chi-squared variable lies above a value; `freedom` at least 1, value at least 0.

    Q(a + 1, x) = Q(a, x) + x^a exp(-x) / gamma(a + 1), from erfc(sqrt(x)) for a = 1/2 or exp(-x) for a = 1.
    """
    x = value / 2
    if freedom % 2:
        above, part, a = erfc(sqrt(x)), 2 * sqrt(x / pi) * exp(-x), 0.5
    else:
        above, part, a = exp(-x), x * exp(-x), 1.0
    while 2 * a < freedom:
        above += part
        a += 1
        part *= x / a
    return min(above, 1.0)
