"""Numbers as text, with their errors: `(1.23 ± 0.04) × 10⁵`; and as colours: `Shade`.

A number that a person reads has three significant digits at most; its error, of two at most, ends at the same place, or is
left out where these digits do not show it.  Records keep all digits.  None, *not determined* in a record, is an en dash.  The
spaces within a number are HARD, so that it is not broken over lines.
"""

import math
from collections.abc import Callable, Iterable
from decimal import Decimal
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, UInt8
from msgspec import UNSET, Struct, UnsetType, structs

SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
UNDETERMINED = "–"
HARD = "\N{NO-BREAK SPACE}"
PLUS_MINUS, TIMES = f"{HARD}±{HARD}", f"{HARD}×{HARD}"
DIGITS = 3  # significant
AGREES = 0.2  # largest |ratio - 1| of two numbers that are said to agree
BYTES, NOTHING = 254, 255  # of a scale in bytes: its upper end, and the code of no value
# ends of a scale beyond which values lie, if not both
BEYOND: dict[str, Any] = {"error": "max", "one_view": "neither", "difference": "neither"}
GREY = 128  # the colour of no value, in bytes
SCORES = {"psnr": "PSNR (dB)", "ssim": "SSIM", "lpips": "LPIPS (VGG)", "avge": "AVGE"}  # of metrics.json
PLACES = {"psnr": 2, "ssim": 4, "lpips": 4, "avge": 4}


def quantity(value: float | None, error: float | None = None) -> str:
    """`value ± error` as text.

    >>> texts = quantity(123456.0, 4321.0), quantity(-0.0123), quantity(3e-12, 1e-11), quantity(None)
    >>> [text.replace(HARD, " ") for text in texts]
    ['(1.23 ± 0.04) × 10⁵', '−0.0123', '(0.3 ± 1.0) × 10⁻¹¹', '–']
    >>> quantity(105.598, 0.00035), quantity(20.0, 1.23).replace(HARD, " "), quantity(2.0, 0.004)
    ('106', '20.0 ± 1.2', '2.00')
    >>> [quantity(*each).replace(HARD, " ") for each in ((9.96e-6, 2e-6), (5.0, 0.0998))]  # rounding adds a digit
    ['(1.00 ± 0.20) × 10⁻⁵', '5.00 ± 0.10']
    """
    if value is None:
        return UNDETERMINED
    if not math.isfinite(value):
        return "not a number" if math.isnan(value) else "−∞" if value < 0 else "∞"
    if error is None or error == 0:
        return _plain(value)
    if not 0 < error < math.inf:
        return f"{_plain(value)}{PLUS_MINUS}?"
    exponent = _exponent(max(abs(value), error))
    places = min(1 - _exponent(error, 2), DIGITS - 1 - exponent)
    if Decimal(error).scaleb(places) < Decimal("0.5"):
        return _plain(value)
    # to these places it may have a digit more
    exponent = _exponent(float(round(Decimal(max(abs(value), error)), places)))
    if -3 <= exponent <= 3:
        return f"{_fixed(value, 0, places)}{PLUS_MINUS}{_fixed(error, 0, places)}"
    places += exponent
    digits = f"{_fixed(value, exponent, places)}{PLUS_MINUS}{_fixed(error, exponent, places)}"
    return f"({digits}){TIMES}{power_of_ten(exponent)}"


def rough(value: float | None) -> str:
    """A number in two digits, for a sentence.

    >>> [text.replace(HARD, " ") for text in map(rough, (27.438, 163.0, -0.16863, 2.5e-5, 9.98e-4, None))]
    ['27', '160', '−0.17', '2.5 × 10⁻⁵', '0.0010', '–']
    """
    return UNDETERMINED if value is None else _plain(value, 2) if math.isfinite(value) else quantity(value)


def extent(values: Iterable[float], words: Callable[[float], str] = rough) -> str:
    """The least and the largest number in words, once where they read alike.

    >>> extent([1.57, 2.16, 1.12]), extent([2.0, 2.01])
    ('1.1 to 2.2', '2.0')
    """
    known = sorted(map(float, values))
    return " to ".join(dict.fromkeys((words(known[0]), words(known[-1]))))


def solved(value: float | None, residual: float | None) -> str:
    """`measured` of an eigenvalue, whose error, the residual, is named as numerical: other trainings differ by more.

    >>> [text.replace(HARD, " ") for text in (solved(27.438, 1e-5), solved(-0.17, 0.02), solved(1.0, None))]
    ['27.4', '−0.170 ± 0.020 (numerical)', '1.00 ± ? (numerical)']
    """
    text = measured(value, residual)
    return f"{text} (numerical)" if PLUS_MINUS in text else text


def measured(value: float | None, error: float | None) -> str:
    """`quantity` of a number that has an error; an error of None, not determined, is written "± ?".

    >>> [text.replace(HARD, " ") for text in (measured(5.0, None), measured(5.0, 0.0), measured(None, None))]
    ['5.00 ± ?', '5.00', '–']
    """
    return quantity(value, math.inf if error is None else error)


def apart(error: float | UnsetType | None) -> str:
    """The error due to views left out, to follow a number's own error; empty where none were left out.

    >>> apart(0.123), apart(None), apart(UNSET)
    (' ∓ 0.12', ' ∓ ?', '')
    """
    if error is UNSET:
        return ""
    return " ∓ ?" if error is None else f" ∓ {_plain(error, 2)}"


def percent(share: float) -> str:
    """A share as a percentage, with one more place near 0 and near 1.

    >>> percent(0.314), percent(0.0031), percent(0.9987), percent(1.0), percent(0.0), percent(1e-5)
    ('31%', '0.3%', '99.9%', '100%', '0%', 'less than 0.1%')
    """
    if 0 < share < 0.0005:
        return "less than 0.1%"
    return f"{share:.1%}" if 0 < share < 0.01 or 0.99 < share < 0.9995 else f"{share:.0%}"


def ratio(aspect: float) -> str:
    """Aspect ratio, length to width.

    >>> ratio(1465.0), ratio(20.8), ratio(3.14)
    ('1500 : 1', '21 : 1', '3.1 : 1')
    """
    return f"{rough(aspect)} : 1"


def limits(low: float | None, high: float | None) -> str:
    """Both ends of an interval; one number where both look alike.

    >>> limits(0.17504, 0.17531), limits(None, 2.0)
    ('0.175', '– … 2.00')
    """
    return " … ".join(dict.fromkeys((quantity(low), quantity(high))))


def folded(text: str, width: int) -> str:
    """Numbers as text, broken in two at ± or … where they are wider than this.

    >>> folded("7.45 × 10⁻⁴ … 1.02 × 10⁴", 15), folded("34.1 … 120", 15)
    ('7.45 × 10⁻⁴ …\\n1.02 × 10⁴', '34.1 … 120')
    """
    return text if len(text) <= width else text.replace(PLUS_MINUS, f"\n±{HARD}").replace(" … ", " …\n")


def power_of_ten(exponent: int) -> str:
    """10 to this power, in superscript digits.

    >>> power_of_ten(-12)
    '10⁻¹²'
    """
    return f"10{str(exponent).translate(SUPERSCRIPTS)}"


def exponent_of(*values: np.ndarray | float) -> int:
    """The power of ten to take out of an axis: a multiple of three, 0 for numbers of 0.05 to 5000.

    >>> exponent_of(4.2e-7), exponent_of(np.array([0.0, 30.0])), exponent_of(-8.1e9)
    (-9, 0, 9)
    """
    finite = np.concatenate([np.abs(np.ravel(v)) for v in values])
    largest = np.max(finite[np.isfinite(finite)], initial=0.0)
    if largest == 0 or 0.05 <= largest < 5000:
        return 0
    return 3 * math.floor(math.log10(largest) / 3)


def unit_suffix(exponent: int) -> str:
    """Suffix of an axis label for the power of ten that was taken out.

    >>> unit_suffix(-6), unit_suffix(0)
    (' (×10⁻⁶)', '')
    """
    return f" (×{power_of_ten(exponent)})" if exponent else ""


def _plain(value: float, digits: int = DIGITS) -> str:
    """`value` with this many significant digits."""
    exponent = _exponent(value, digits)
    if value == 0:
        return "0"
    if -3 <= exponent <= 3:
        return _fixed(value, 0, digits - 1 - exponent)
    return f"{_fixed(value, exponent, digits - 1)}{TIMES}{power_of_ten(exponent)}"


def _fixed(value: float, exponent: int, places: int) -> str:
    """value / 10**exponent, rounded to this many places; by Decimal, because 10.0**exponent may underflow."""
    scaled = round(Decimal(value).scaleb(-exponent), places)
    return f"{scaled:.{max(0, places)}f}".replace("-", "−")


def _exponent(value: float, digits: int = DIGITS) -> int:
    """Decimal exponent of the leading digit after rounding to so many digits; 0 for 0."""
    return int(f"{value:.{digits - 1}e}".partition("e")[2])


class Shade(Struct, frozen=True, kw_only=True):
    """A colour scale of a field: a value v has the colour of t, on a map from t = `low` to t = `high`.

    log      t = log10 v, v > 0
    signed   t = asinh(v / soft), with low = -high where v has both signs
    linear   t = v
    """

    name: str
    words: str
    unit: str
    scale: Literal["log", "signed", "linear"]
    low: float
    high: float
    soft: float = 1.0

    def __post_init__(self) -> None:
        try:
            ends = [self.value(self.low), self.value(self.high)]
        except OverflowError:
            ends = [math.inf]
        if not (np.isfinite(ends).all() and self.low <= self.high):
            raise ValueError(f"Expected a scale between numbers, got one from {self.low} to {self.high}")

    @classmethod
    def of(
        cls,
        name: str,
        words: str,
        unit: str,
        scale: Literal["log", "signed", "linear"],
        values: Float[np.ndarray, " n"],
        weights: Float[np.ndarray, " n"],
        percentiles: tuple[float, float] = (10.0, 98.0),
    ) -> "Shade":
        """The scale whose ends are weighted percentiles of the values; soft: their weighted median magnitude.

        >>> shade = Shade.of("x", "size", "px", "log", np.array([1.0, 10.0, 1e3]), np.ones(3))
        >>> shade.low, shade.high, shade.share(np.array([1.0, 1e9, -1.0])).tolist()
        (0.0, 3.0, [0.0, 1.0, nan])
        """
        shade = cls(name=name, words=words, unit=unit, scale=scale, low=0.0, high=1.0)
        used = np.isfinite(values) & (weights > 0) & ((values > 0) | (scale != "log"))
        if not used.any():
            return shade
        values, weights = values[used], weights[used]
        soft = _percentile(np.abs(values), weights, 50.0) or float(np.abs(values).max()) or 1.0
        shade = structs.replace(shade, soft=soft)
        low, high = (float(shade.shown(np.array(_percentile(values, weights, each)))) for each in percentiles)
        if scale == "signed" and low < 0 < high:
            low, high = -max(-low, high), max(-low, high)
        return structs.replace(shade, low=low, high=high if high > low else low + 1)

    @property
    def title(self) -> str:
        """Name and unit."""
        return f"{self.words}, {self.unit}" if self.unit else self.words

    @property
    def diverges(self) -> bool:
        """Whether t = 0 is in the middle."""
        return self.scale != "log" and self.low == -self.high

    @property
    def colours(self) -> str:
        """Name of matplotlib's colour map, one for colour-blind eyes, in which the fragile or wrong values are bright."""
        if self.diverges:
            return "PuOr_r"
        return "magma" if self.name == "error" else "cividis_r" if self.falls else "cividis"

    @property
    def falls(self) -> bool:
        """Whether the scale is drawn from high to low, so that its bright end is at the right, as in all other scales."""
        return self.name == "order_gap"

    @property
    def palette(self) -> UInt8[np.ndarray, "256 3"]:
        """The colours of `bytes`; grey of no value."""
        from matplotlib import colormaps  # slow to import, and most readers of a record need no colours

        colours = colormaps[self.colours](np.arange(NOTHING + 1) / BYTES)[:, :3]
        colours[NOTHING] = GREY / 255
        return (255 * colours).round().astype(np.uint8)

    @property
    def legend(self) -> str:
        """The colours and the values at both ends, ≤ and ≥ where others lie beyond, in HTML."""
        stops = ", ".join(
            "rgb({}, {}, {})".format(*colour) for colour in self.palette[np.linspace(0, BYTES, 9, dtype=int)]
        )
        signs = {"max": " ≥", "neither": "  "}.get(BEYOND.get(self.name, ""), "≤≥")
        ends = [f"{sign} {rough(self.value(t))}".strip() for sign, t in zip(signs, (self.low, self.high), strict=True)]
        way = "right"
        if self.falls:
            ends, way = ends[::-1], "left"
        middle = "<span class=scale>logarithmic</span>" if self.scale == "log" else ""
        return (
            f'<span style="display:block;height:.5em;background:linear-gradient(to {way}, {stops})"></span><span '
            f'style="display:flex;gap:.5em;justify-content:space-between"><span>{ends[0]}</span>{middle}<span>{ends[1]}</span></span>'
        )

    def colours_of(self, values: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
        """The colours of values, within [0, 1], float32."""
        return (self.palette[self.bytes(values)] / 255).astype(np.float32)

    def shown(self, values: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        """t; nan where it is not defined."""
        values = np.asarray(values, float)
        if self.scale == "log":
            return np.log10(np.where(values > 0, values, np.nan))
        return np.arcsinh(values / self.soft) if self.scale == "signed" else values

    def value(self, t: float) -> float:
        """The inverse of `shown`."""
        return 10.0**t if self.scale == "log" else self.soft * math.sinh(t) if self.scale == "signed" else t

    def share(self, values: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        """Position of t between `low` and `high`, within [0, 1]; nan where t is not finite."""
        t = self.shown(values)
        return np.where(np.isfinite(t), np.clip((t - self.low) / (self.high - self.low), 0, 1), np.nan)

    def bytes(self, values: Float[np.ndarray, "..."]) -> UInt8[np.ndarray, "..."]:
        """`share` by `share_in_bytes`."""
        return share_in_bytes(self.share(values))


def share_in_bytes(share: Float[np.ndarray, "..."]) -> UInt8[np.ndarray, "..."]:
    """[0, 1] as 0 to BYTES, nan as NOTHING.

    >>> share_in_bytes(np.array([0.0, 0.5, 1.0, np.nan])).tolist()
    [0, 127, 254, 255]
    """
    return np.where(np.isnan(share), NOTHING, np.round(BYTES * np.clip(np.nan_to_num(share), 0, 1))).astype(np.uint8)


def _percentile(values: Float[np.ndarray, " n"], weights: Float[np.ndarray, " n"], percent: float) -> float:
    """Weighted percentile: the least value whose weight, with that of all smaller ones, reaches this share of the total."""
    order = np.argsort(values, kind="stable")
    total = np.cumsum(weights[order])
    return float(values[order][min(np.searchsorted(total, percent / 100 * total[-1]), len(order) - 1)])
