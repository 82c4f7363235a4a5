"""What is wrong with the numbers of densities that were refused track by track."""

from __future__ import annotations

import math

import numpy as np

from fusion_service.arrays import Floats
from fusion_service.hints.finding import Finding
from schemas import FAULTS, LocalIntensity, LocalTracks, check_numbers, pack_lower

__all__ = ["number_finding"]

SOME = 256
"""Components that are looked at."""


def number_finding(message: LocalTracks | LocalIntensity, reason: str) -> Finding:
    """The first track of `message` that is refused for `reason`, one of `schemas.FAULTS`, and what mends it."""
    with np.errstate(all="ignore"):
        return _number_finding(message, reason)


def _number_finding(message: LocalTracks | LocalIntensity, reason: str) -> Finding:
    code = FAULTS.index(reason) if reason in FAULTS else -1
    at = np.flatnonzero(check_numbers([message])[0] == code)
    if not len(at):
        return Finding(reason, "", "", f"{reason}: see WIRE.md, Refusals")
    place, which = int(at[0]), f"of {len(at)} tracks"
    first = place
    if isinstance(message, LocalTracks):
        counts = message.counts
        first = place if counts is None else int(counts[:place].sum(dtype=np.int64))
        which = f"of track {int(message.ids[place])}" + (f" and {len(at) - 1} more" if len(at) > 1 else "")
    if reason in ("weights", "existence", "extent"):
        field, value, said = _of_a_track(message, reason, place, first)
    else:
        last = first + 1
        if isinstance(message, LocalTracks) and message.counts is not None:
            last = first + int(message.counts[place])
        field, value, said = _density(message, first, last, reason)
    return Finding(reason, field, value, f"`{field}` {which}: {said}")


def _density(message: LocalTracks | LocalIntensity, first: int, last: int, reason: str) -> tuple[str, str, str]:
    single = [check_numbers([_one(message, k)])[0][0] for k in range(first, min(last, first + SOME))]
    first += next((k for k, code in enumerate(single) if code), 0)
    mean, covariance = message.means[first], message.covariances[first]
    if reason == "not-finite":
        bad = np.flatnonzero(~np.isfinite(mean))
        if len(bad):
            name = message.space[int(bad[0])]
            return "means", str(mean[bad[0]]), f"{name} is {mean[bad[0]]}: leave out what is not known, or the track"
        return "covs", "nan", "not all numbers are finite: leave the track out until it has a covariance"
    if _swapped_bytes(message):
        return (
            "means",
            f"{mean[0]:.3g}",
            "the numbers make sense with their bytes turned: are they big-endian? send <f8",
        )
    variances = np.diag(covariance)
    if reason != "out-of-range" and _is_upper(covariance):
        return "covs", "", "it is positive definite if read as the upper triangle: send the lower one, row by row"
    for name, value in zip(message.space, variances.tolist(), strict=True):
        if value <= 0:
            word = "0" if value == 0 else f"{value:.3g}"
            more = "leave the component out of space" if value == 0 else "are these the numbers that were meant?"
            return "covs", word, f"the variance of {name} is {word}: it must be above 0; if {name} is not known, {more}"
    if reason == "out-of-range":
        large = np.abs(mean) > 1e12
        if large.any():
            name = message.space[int(np.argmax(large))]
            return "means", f"{mean[large][0]:.3g}", f"{name} is {mean[large][0]:.3g}, beyond 1e12: is it in m?"
        return "covs", f"{variances.max():.3g}", "a variance is above 1e24 or below 1e-20: is it in m2?"
    return _indefinite(covariance)


def _is_upper(covariance: Floats) -> bool:
    """Whether the numbers are those of an upper triangle, row by row."""
    n = len(covariance)
    rows, columns = np.triu_indices(n)
    upper = np.zeros((n, n))
    upper[rows, columns] = upper[columns, rows] = pack_lower(covariance)
    return bool(np.isfinite(upper).all() and (np.linalg.eigvalsh(upper) > 0).all())


def _indefinite(covariance: Floats) -> tuple[str, str, str]:
    n = len(covariance)
    lowest = float(np.linalg.eigvalsh(covariance)[0]) if np.isfinite(covariance).all() else math.nan
    value = f"lowest eigenvalue {lowest:.3g}"
    scale = np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))
    off = np.abs(covariance / scale)
    np.fill_diagonal(off, 0.0)
    if off.max() > 1.0 + 1e-9:
        i, j = divmod(int(off.argmax()), n)
        said = (
            f"element ({max(i, j)}, {min(i, j)}) is larger than its variances allow (correlation {off[i, j]:.3g}): "
            f"are the numbers in the order of space, lower triangle row by row?"
        )
        return "covs", value, said
    return "covs", value, "it is not positive definite: is it rounded, or edited by hand? make it (P + P')/2 + small I"


def _one(message: LocalTracks | LocalIntensity, k: int) -> LocalIntensity:
    """One component, to be checked by itself."""
    return LocalIntensity(
        source=message.source,
        epoch=message.epoch,
        seq=message.seq,
        sent=message.sent,
        time=message.time,
        space=message.space,
        frame=message.frame,
        weights=np.ones(1),
        means=message.means[k : k + 1],
        covariances=message.covariances[k : k + 1],
    )


def _swapped_bytes(message: LocalTracks | LocalIntensity) -> bool:
    """Whether means and covariances look like numbers of a place only if read from the other end."""

    def sane(values: Floats) -> bool:
        size = np.abs(values[values != 0])
        return bool(len(size)) and bool(((size > 1e-12) & (size < 1e12)).all())

    means, covariances = message.means[:SOME], message.covariances[:SOME]
    variances = np.einsum("bii->bi", covariances)
    turned = sane(variances.byteswap()) and (sane(means.byteswap()) or not means.any())
    return turned and not sane(variances)


def _of_a_track(message: LocalTracks | LocalIntensity, reason: str, place: int, first: int) -> tuple[str, str, str]:
    if reason == "existence" and isinstance(message, LocalTracks) and message.existence is not None:
        value = float(message.existence[place])
        percent = "is it in percent? " if 1.0 < value <= 100.0 else ""
        return reason, f"{value:.4g}", f"it is {value:.4g}: {percent}it must be a probability from 0 to 1"
    if reason == "weights" and isinstance(message, LocalTracks) and message.weights is not None:
        count = 1 if message.counts is None else int(message.counts[place])
        total = float(message.weights[first : first + count].sum())
        percent = "are they in percent? " if abs(total - 100.0) < 1e-3 else ""
        return reason, f"{total:.6g}", f"they sum to {total:.6g}: {percent}they must sum to 1 in each track"
    if reason == "extent" and isinstance(message, LocalTracks) and message.extent is not None:
        length, width, heading = message.extent[place].tolist()
        shown = f"{length:.4g}, {width:.4g}, {heading:.4g}"
        if abs(heading) > 2 * math.pi:
            return reason, shown, f"its heading is {heading:.4g}: is it in degrees? angles are in rad"
        if width > length:
            return reason, shown, f"its width {width:.4g} is above its length {length:.4g}: are they swapped?"
        return reason, shown, f"it is {shown}: sizes are above 0 and at most 10,000 m"
    return reason, "", "a negative or infinite number: see WIRE.md, Refusals"
