"""Two numbers, or two arrays of them, that are not the same bit for bit: how far apart, and how.

Equality is that of the bits: 0.0 and -0.0 differ, and a NaN equals only a NaN of the same payload.
Distances are taken in the width the field has in its message.
"""

from __future__ import annotations

import math
import struct
from typing import Any

import numpy as np
import numpy.typing as npt

from rsltrace.diff.facts.evidence import FieldDifference, FieldNote, FieldNoteKind
from rsltrace.diff.values.globs import FieldRules

BINARY_ITEMS_MIN = 65
"""From this length on an array of bytes is shown as a hex dump, not as numbers."""
_FIRST = 5
_ROW_BYTES = 16
_ROWS = 3
_QUIET_NAN = {32: 0x7FC00000, 64: 0x7FF8000000000000}
_FORMATS = {32: ("<f", "<I"), 64: ("<d", "<Q")}


def number_text(value: Any, type_name: str = "float64") -> str:
    """Return a number in full: the shortest text that reads back as the same value."""
    if isinstance(value, (bool, np.bool_)):
        return "true" if value else "false"
    if isinstance(value, (float, np.floating)):
        bits = _width(type_name)
        if math.isnan(value):
            pattern = float_bits(float(value), bits)
            usual = pattern == _QUIET_NAN[bits]
            return "nan" if usual else f"nan(0x{pattern:0{bits // 4}x})"
        return _float32_text(np.float32(value)) if bits == 32 else repr(float(value))
    return str(int(value))


def _float32_text(value: np.float32) -> str:
    """Return what ``repr`` says of a float64 for a float32; numpy's own text changed with time."""
    if value == 0.0 or 1e-4 <= abs(value) < 1e16:
        return np.format_float_positional(value, unique=True, trim="0")
    if np.isinf(value):
        return "inf" if value > 0 else "-inf"
    return np.format_float_scientific(value, unique=True, trim="-", exp_digits=2)


def float_bits(value: float, bits: int) -> int:
    """Return the bit pattern of a float of 32 or 64 bits."""
    as_float, as_int = _FORMATS[bits]
    pattern: int = struct.unpack(as_int, struct.pack(as_float, value))[0]
    return pattern


def ulp_distance(a: float, b: float, bits: int) -> int | None:
    """Return how many floats of that width lie between two (plus one); None with NaN or infinity.

    0.0 and -0.0 are at the same place.
    """
    if not (math.isfinite(a) and math.isfinite(b)):
        return None
    sign = 1 << (bits - 1)
    places = [-(p ^ sign) if p & sign else p for p in (float_bits(a, bits), float_bits(b, bits))]
    return abs(places[0] - places[1])


def same_number(a: Any, b: Any) -> bool:
    """Whether two Python numbers of one type are the same bit for bit."""
    if isinstance(a, float) and (a != a or b != b or a == 0.0):
        return struct.pack("<d", a) == struct.pack("<d", b)
    return bool(a == b)


def diff_numbers(path: str, a: Any, b: Any, type_name: str, rules: FieldRules) -> FieldDifference:
    """Return how two different numbers (or truth values) differ."""
    text_a, text_b = number_text(a, type_name), number_text(b, type_name)
    if isinstance(a, bool) or isinstance(b, bool):
        return FieldDifference(path, text_a, text_b)
    if not isinstance(a, float):
        distance = float(abs(a - b))
        covered = rules.covers(path, distance, float(max(abs(a), abs(b))))
        return FieldDifference(path, text_a, text_b, distance, within_tolerance=covered)
    kind = _float_note(a, b)
    notes = (FieldNote(kind),) if kind is not None else ()
    if not (math.isfinite(a) and math.isfinite(b)):
        both_nan = math.isnan(a) and math.isnan(b)
        covered = both_nan and rules.tolerance(path) is not None
        return FieldDifference(path, text_a, text_b, notes=notes, within_tolerance=covered)
    distance = abs(a - b)
    return FieldDifference(
        path,
        text_a,
        text_b,
        distance,
        ulp_distance(a, b, _width(type_name)),
        notes,
        within_tolerance=rules.covers(path, distance, max(abs(a), abs(b))),
    )


def diff_arrays(
    path: str, a: npt.NDArray[Any], b: npt.NDArray[Any], rules: FieldRules
) -> FieldDifference | None:
    """Return how two arrays of numbers of one type differ, or None if they do not.

    One different element is reported as itself (``ranges[17]``), more are summarised.
    """
    common = min(len(a), len(b))
    places = _unequal(a[:common], b[:common])
    if rules.by_element and len(places):
        ignored = [rules.ignored(f"{path}[{place}]") for place in places.tolist()]
        places = places[~np.array(ignored, dtype=bool)]
    if not len(places) and len(a) == len(b):
        return None
    left, right = a[places], b[places]
    distances = _distances(left, right)
    covered = _covered(path, places, left, right, distances, rules)
    all_covered = len(a) == len(b) and bool(covered.all())
    longest = max(len(a), len(b))
    count = len(places) + longest - common
    type_name = a.dtype.name
    if count == 1 and len(a) == len(b):
        place = int(places[0])
        one = diff_numbers(f"{path}[{place}]", a[place].item(), b[place].item(), type_name, rules)
        return _with_elements(one, longest, all_covered)
    finite = distances[np.isfinite(distances)] if a.dtype.kind != "b" else distances[:0]
    binary = a.dtype == np.uint8 and longest >= BINARY_ITEMS_MIN
    return FieldDifference(
        path,
        _short_array(a, binary),
        _short_array(b, binary),
        ulp=_largest_ulp(left, right),
        notes=_array_notes(a, b, places, binary),
        elements=(count, longest),
        first=_hex_rows(a, b, places) if binary else _first_elements(a, b, places),
        smallest=float(np.min(finite)) if len(finite) else None,
        largest=float(np.max(finite)) if len(finite) else None,
        within_tolerance=all_covered,
        binary=binary,
    )


def array_text(values: npt.NDArray[Any], count: int = 4) -> str:
    """Return an array as ``[0.1, … 360 in all]``: the first few elements, and how many if more."""
    type_name = values.dtype.name
    shown = [number_text(value, type_name) for value in values[:count].tolist()]
    more = [f"… {len(values)} in all"] if len(values) > count else []
    return f"[{', '.join(shown + more)}]" if len(shown) + len(more) != 1 else f"[{shown[0]}]"


def _same_elements(a: npt.NDArray[Any], b: npt.NDArray[Any]) -> bool:
    """Whether two arrays have the same elements, each as often."""
    return not len(_unequal(np.sort(a), np.sort(b)))


def _width(type_name: str) -> int:
    return 32 if type_name == "float32" else 64


def _unequal(a: npt.NDArray[Any], b: npt.NDArray[Any]) -> npt.NDArray[np.intp]:
    if a.dtype.kind == "f" and a.dtype == b.dtype:
        pattern = np.dtype(f"{a.dtype.byteorder}u{a.dtype.itemsize}")
        a, b = np.ascontiguousarray(a).view(pattern), np.ascontiguousarray(b).view(pattern)
    return np.flatnonzero(a != b)


def _distances(a: npt.NDArray[Any], b: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
    """Return |a-b| per element as float64, exact before it is rounded to that."""
    if a.dtype.kind == "f":
        with np.errstate(all="ignore"):
            difference: npt.NDArray[np.float64] = np.abs(
                a.astype(np.float64) - b.astype(np.float64)
            )
            return difference
    if a.dtype.kind == "b":
        return np.ones(len(a))
    # The difference of two 64-bit integers needs 64 bits without a sign, and wraps into them.
    high, low = np.maximum(a, b), np.minimum(a, b)
    exact: npt.NDArray[np.uint64] = high.astype(np.uint64) - low.astype(np.uint64)
    return exact.astype(np.float64)


def _covered(
    path: str,
    places: npt.NDArray[np.intp],
    a: npt.NDArray[Any],
    b: npt.NDArray[Any],
    distances: npt.NDArray[np.float64],
    rules: FieldRules,
) -> npt.NDArray[np.bool_]:
    """Return which of the different elements a tolerance covers."""
    covered: npt.NDArray[np.bool_] = np.zeros(len(places), dtype=bool)
    if a.dtype.kind == "b":
        return covered
    sizes = np.maximum(np.abs(a.astype(np.float64)), np.abs(b.astype(np.float64)))
    comparable = np.isfinite(distances)
    both_nan = np.isnan(a) & np.isnan(b) if a.dtype.kind == "f" else ~comparable
    tolerance = rules.tolerance(path)
    if tolerance is not None:
        with np.errstate(all="ignore"):
            close = (distances <= tolerance[0]) | (distances <= tolerance[1] * sizes)
        covered = (comparable & close) | both_nan
    if rules.by_element:
        for position in np.flatnonzero(~covered).tolist():
            name = f"{path}[{places[position]}]"
            if both_nan[position]:
                covered[position] = rules.tolerance(name) is not None
            elif comparable[position]:
                covered[position] = rules.covers(
                    name, float(distances[position]), float(sizes[position])
                )
    return covered


def _with_elements(one: FieldDifference, of: int, covered: bool) -> FieldDifference:
    return FieldDifference(
        one.path,
        one.a,
        one.b,
        one.absolute,
        one.ulp,
        one.notes,
        elements=(1, of),
        within_tolerance=covered,
    )


def _largest_ulp(a: npt.NDArray[Any], b: npt.NDArray[Any]) -> int | None:
    """Return the largest distance in units in the last place among finite floats."""
    if a.dtype.kind != "f":
        return None
    finite = np.isfinite(a) & np.isfinite(b)
    if not finite.any():
        return None
    width = a.dtype.itemsize
    signed, magnitude = np.dtype(f"=i{width}"), (1 << (8 * width - 1)) - 1
    native = np.dtype(f"=f{width}")
    sides = []
    for side in (a[finite], b[finite]):
        pattern = np.ascontiguousarray(side.astype(native)).view(signed)
        sides.append(np.where(pattern < 0, -(pattern & signed.type(magnitude)), pattern))
    high, low = np.maximum(*sides), np.minimum(*sides)
    return int(np.max(high.astype(np.uint64) - low.astype(np.uint64)))


def _float_note(a: float, b: float) -> FieldNoteKind | None:
    if math.isnan(a) and math.isnan(b):
        return FieldNoteKind.NAN_PAYLOAD
    if math.isnan(a) or math.isnan(b):
        return FieldNoteKind.NAN_IN_A if math.isnan(a) else FieldNoteKind.NAN_IN_B
    if math.isinf(a) and math.isinf(b):
        return FieldNoteKind.OPPOSITE_INFINITIES
    if math.isinf(a) or math.isinf(b):
        return FieldNoteKind.INFINITE_IN_A if math.isinf(a) else FieldNoteKind.INFINITE_IN_B
    return FieldNoteKind.SIGN_OF_ZERO if a == b else None


def _array_notes(
    a: npt.NDArray[Any], b: npt.NDArray[Any], places: npt.NDArray[np.intp], binary: bool
) -> tuple[FieldNote, ...]:
    notes = []
    if len(a) != len(b):
        notes.append(FieldNote(FieldNoteKind.LENGTHS, len(a), len(b)))
    if len(a) == len(b) and len(places) > 1 and _same_elements(a[places], b[places]):
        notes.append(FieldNote(FieldNoteKind.SAME_ELEMENTS))
    if binary and len(places):
        notes.append(FieldNote(FieldNoteKind.FIRST_BYTE, int(places[0])))
    if a.dtype.kind == "f":
        left, right = a[places], b[places]
        nan_a, nan_b = np.isnan(left), np.isnan(right)
        inf_a, inf_b = np.isinf(left), np.isinf(right)
        for kind, mask in (
            (FieldNoteKind.NAN_IN_A, nan_a & ~nan_b),
            (FieldNoteKind.NAN_IN_B, nan_b & ~nan_a),
            (FieldNoteKind.NAN_PAYLOAD, nan_a & nan_b),
            (FieldNoteKind.INFINITE_IN_A, inf_a & ~inf_b & ~nan_b),
            (FieldNoteKind.INFINITE_IN_B, inf_b & ~inf_a & ~nan_a),
            (FieldNoteKind.OPPOSITE_INFINITIES, inf_a & inf_b),
            (FieldNoteKind.SIGN_OF_ZERO, left == right),
        ):
            if mask.any():
                notes.append(FieldNote(kind, count=int(mask.sum())))
    return tuple(notes)


def _short_array(values: npt.NDArray[Any], binary: bool) -> str:
    return f"{len(values)} bytes" if binary else array_text(values)


def _first_elements(
    a: npt.NDArray[Any], b: npt.NDArray[Any], places: npt.NDArray[np.intp]
) -> tuple[tuple[int, str, str], ...]:
    common, longest = min(len(a), len(b)), max(len(a), len(b))
    chosen = [*places[:_FIRST].tolist(), *range(common, longest)][:_FIRST]

    def text(values: npt.NDArray[Any], place: int) -> str:
        if place >= len(values):
            return "absent"
        return number_text(values[place].item(), values.dtype.name)

    return tuple((place, text(a, place), text(b, place)) for place in chosen)


def _hex_rows(
    a: npt.NDArray[Any], b: npt.NDArray[Any], places: npt.NDArray[np.intp]
) -> tuple[tuple[int, str, str], ...]:
    """Return the first rows of a hex dump that differ, each as (offset of its start, a, b)."""
    common, longest = min(len(a), len(b)), max(len(a), len(b))
    rows = np.unique(places // _ROW_BYTES)[:_ROWS].tolist()
    if common < longest and len(rows) < _ROWS and common // _ROW_BYTES not in rows:
        rows.append(common // _ROW_BYTES)
    shown = []
    for row in rows:
        start, end = row * _ROW_BYTES, (row + 1) * _ROW_BYTES
        left, right = (side[start:end].tobytes().hex(" ") or "absent" for side in (a, b))
        shown.append((start, left, right))
    return tuple(shown)
