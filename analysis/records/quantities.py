"""How numbers with errors are written for people: `(1.23 ± 0.04) × 10⁵`.

The error is rounded to two significant digits and the value to the same place; without an error a number keeps three
significant digits.  None, *not determined* in a record, is an en dash.
"""

import math
from decimal import Decimal

SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
UNDETERMINED = "–"
FINEST = 10  # significant digits
SCORES = {"psnr": "PSNR (dB)", "ssim": "SSIM", "lpips": "LPIPS"}  # of metrics.json
PLACES = {"psnr": 2, "ssim": 4, "lpips": 4}


def quantity(value: float | None, error: float | None = None) -> str:
    """`value ± error` as text.

    >>> quantity(123456.0, 4321.0), quantity(-0.0123), quantity(3e-12, 1e-11), quantity(None)
    ('(1.235 ± 0.043) × 10⁵', '−0.0123', '(0.3 ± 1.0) × 10⁻¹¹', '–')
    """
    if value is None:
        return UNDETERMINED
    if not math.isfinite(value):
        return "not a number" if math.isnan(value) else "−∞" if value < 0 else "∞"
    if error is None or not math.isfinite(error) or error <= 0:
        return _plain(value) if error is None or error == 0 else f"{_plain(value)} ± ?"
    if error < 1e-9 * abs(value):
        return f"{_plain(value, FINEST)} ± {_plain(error, 2)}"
    exponent = _exponent(max(abs(value), error))
    places = 1 - _exponent(error)
    if -3 <= exponent <= 3:
        return f"{_fixed(value, 0, places)} ± {_fixed(error, 0, places)}"
    places += exponent
    return f"({_fixed(value, exponent, places)} ± {_fixed(error, exponent, places)}) × {power_of_ten(exponent)}"


def measured(value: float | None, error: float | None) -> str:
    """`quantity` for a number that comes with an error: where that is not determined, it says so.

    >>> measured(5.0, None), measured(5.0, 0.0), measured(None, None)
    ('5.00 ± ?', '5.00', '–')
    """
    return quantity(value, math.inf if error is None else error)


def limits(low: float | None, high: float | None) -> tuple[str, str]:
    """Both ends of an interval, to three significant digits or to as many as tell them apart.

    >>> limits(0.17504, 0.17531), limits(None, 2.0), limits(1.0, 1.0)
    (('0.1750', '0.1753'), ('–', '2.00'), ('1.00', '1.00'))
    """
    texts = quantity(low), quantity(high)
    if low is None or high is None or low == high:
        return texts
    for digits in range(4, FINEST + 1):
        if texts[0] != texts[1]:
            break
        texts = _plain(low, digits), _plain(high, digits)
    return texts


def power_of_ten(exponent: int) -> str:
    """10 to this power, in superscript digits.

    >>> power_of_ten(-12)
    '10⁻¹²'
    """
    return f"10{str(exponent).translate(SUPERSCRIPTS)}"


def _plain(value: float, digits: int = 3) -> str:
    """`value` with so many significant digits."""
    exponent = _exponent(value)
    if value == 0:
        return "0"
    if -3 <= exponent <= 3:
        return _fixed(value, 0, digits - 1 - exponent)
    return f"{_fixed(value, exponent, digits - 1)} × {power_of_ten(exponent)}"


def _fixed(value: float, exponent: int, places: int) -> str:
    """value / 10**exponent, rounded to so many places; Decimal, because 10.0**exponent may underflow."""
    scaled = round(Decimal(value).scaleb(-exponent), places)
    return f"{scaled:.{max(0, places)}f}".replace("-", "−")


def _exponent(value: float) -> int:
    """Of the leading digit after rounding to three digits; 0 for 0."""
    return int(f"{value:.2e}".partition("e")[2])
