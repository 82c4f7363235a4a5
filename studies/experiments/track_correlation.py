"""How correlated the errors of local tracks are in scenarios that trackers meet, and what each rule then gives: to
choose the bound of `bci`, `max_correlation`, with a reason.

That bound is on the largest singular value of L1^-1 P12 L2^-T, P1 = L1 L1' and P2 = L2 L2' as the tracks report them:
the largest canonical correlation, over all combinations of position and velocity. Joint error covariances are exact, by
Bar-Shalom's recursion for cross-covariances (`studies/local_tracks.py`); a test compares them with simulated filters.
Targets move in the plane with nearly constant velocity; all sensors measure the position at the same times, T = 1 s
apart, unless said.

* Process noise: the same target seen by two or three sensors that share nothing else, in steady state. Index: q T^3 /
  sigma^2 with the noise intensity q and the first sensor's standard deviation; 1:3 are the sensors' deviations.
* Prior: both tracks start from one estimate (a steady track of index 0.1, handed over), no process noise, then k
  measurements of each one's own.
* Memory: the last fused result, predicted, beside the fusion of the new local tracks (index 0.1, 1:1), in steady
  state: every second the local tracks are fused by the first rule named, and this with the last result by the second,
  as the centre with `memory = "recursive"` does it.
* Li-AA: its linear scenario, 20 and 40 m, Q = 25 G G', 60 steps; alone, or the fused result fed back to both filters.
* Sharma 6.3: nodes S1 and S2 after five steps; "sampled from" a distribution is read as starts that are independent, or
  one and the same.
* Radars: those of Sharma 6.4 with this repository's numbers (100 m, 3 mrad, scans every 5 s for 300 s, q = 0.02 m2/s3;
  no clutter and no misses), all pairs of radars that see a target throughout, on one plane, filters linearised at the
  truth, speeds at first unknown to both alike. Straight: as the targets of the paper move, while the filters allow for
  process noise. Manoeuvring: the process noise is real.
* Navigation: lidar and radar on one platform (3 and 4 m, q = 0.05 m2/s3), whose own position errs by a common error,
  new at each scan or correlated over 60 s. The filters allow for its variance, but not for its correlation in time.

Tables: the correlation, of the full states and of positions alone; the largest eigenvalue of a track's true covariance
relative to its reported one; variances of position, reported and true, relative to the optimal fusion, which knows J
(`bar-shalom-campo`); and the excess, the largest eigenvalue of the true mean squared error relative to the reported
covariance. Of several pairs of tracks, largest correlations and excess, mean ratios of variances. `bci`: at the
scenario's own correlation (at most 1). `hmd-ga`: means over the difference of the tracks, by whitened draws. Derived:
by what a centre knows that is told nothing but the tracks and the process noise that their filters allow for
(`fusion_service/centre/derived.py`); `bar-shalom-campo` with the cross-covariances, where less than 5 % of the
correlation is left of the unknown start (else as `bci`), `bci` under the bound of each pair.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from itertools import combinations
from typing import Any

import numpy as np

from fusion_service import geodesy
from fusion_service.rules import fuse
from schemas import Ecef
from sensor_clients.scenarios.three_radars import DURATION, RADAR, RADARS, TRACKER, true_states
from studies import pictures
from studies.correlation import draws, excess, expected, independent, largest_correlation, mse, optimal
from studies.local_tracks import Model, Tracks, alike, blocks, filtered, planar, positions, steady
from studies.rules import Fuser, fuser
from studies.study import Floats, Result, Row, Run, Study

OWN_BOUND = "bci"
DERIVED = ("bar-shalom-campo", "bci")
ENOUGH = 0.05
"""Left of the correlation at the start, below which cross-covariances are taken as known."""
GROUPS = 10
"""Independent sets of draws, for the standard error."""


def constant_gain(rule: Fuser, P: Floats) -> tuple[Floats, Floats]:
    """Gains (B, N, n, n) and covariance (B, n, n) of a rule that does not look at the means."""
    _, N, n, _ = P.shape
    found = expected(rule, P, independent(P), draws(np.random.default_rng(0), (N - 1) * n, 0))
    return found.gains, found.reported


def fed_back(model: Model, start: Floats, rule: str, steps: int) -> Tracks:
    """Local tracks just before they are fused, when both filters go on from the fused result."""
    tracks = alike(start, 2)
    for _ in range(steps - 1):
        tracks = filtered(tracks, model, 1)
        gains, P = constant_gain(fuser(rule), tracks.P)
        tracks = alike(P[0], 2, mse(gains, tracks.J)[0])
    return filtered(tracks, model, 1)


def remembered(model: Model, rule: str, bound: float, steps: int = 60) -> Tracks:
    """The predicted last result and the fusion, by `rule`, of new local tracks; `bci` under `bound` fuses the two."""
    n, N = len(model.F), len(model.H)
    seen = model._replace(  # the result is a filter that measures nothing
        H=np.concatenate([np.zeros_like(model.H[:1]), model.H]), R=np.concatenate([model.R[:1], model.R])
    )
    tracks = alike(steady(model).P[0, 0], N + 1)
    last = fuser(f"bci:max_correlation={bound}")
    for k in range(steps):
        tracks = filtered(tracks, seen, 1)
        gains, P = constant_gain(fuser(rule), tracks.P[:, 1:])
        first = np.zeros((1, 2 * n, (N + 1) * n))
        first[:, :n, :n] = np.eye(n)
        first[:, n:, n:] = gains.swapaxes(1, 2).reshape(1, n, N * n)
        two = Tracks(np.stack([tracks.P[:, 0], P], axis=1), first @ tracks.J @ first.swapaxes(1, 2))
        if k == steps - 1:
            break
        gains, P = constant_gain(last, two.P)
        whole = np.broadcast_to(np.eye((N + 1) * n), tracks.J.shape).copy()
        whole[:, :n] = gains.swapaxes(1, 2).reshape(1, n, 2 * n) @ first
        tracks = Tracks(np.concatenate([P[:, None], tracks.P[:, 1:]], axis=1), whole @ tracks.J @ whole.swapaxes(1, 2))
    return two


def sightings() -> Floats:
    """Where targets are, seen from either radar (K, B, 2, 2), m, for all pairs of radars that see one throughout."""
    frame = RADARS["radar1"]

    def east_north(states: Floats) -> Floats:
        space = ("x", "y", "z", "vx", "vy", "vz")
        zeros = np.zeros((*states.shape, 6))
        return np.asarray(geodesy.transform(states, zeros, space, Ecef(), frame)[0][..., :2])

    targets = east_north(true_states(np.arange(0.0, DURATION + RADAR.period / 2, RADAR.period)))
    earth = [np.array([*geodesy.geodetic_to_ecef(r.lat, r.lon, r.alt), 0.0, 0.0, 0.0]) for r in RADARS.values()]
    away = targets[:, :, None] - east_north(np.array(earth))  # (K, targets, radars, 2)
    seen = np.asarray((np.hypot(away[..., 0], away[..., 1]) < RADAR.field_of_view).all(axis=0))
    pairs = [(t, [i, j]) for t in range(len(seen)) for i, j in combinations(range(3), 2) if seen[t, i] and seen[t, j]]
    return np.stack([away[:, t, two] for t, two in pairs], axis=1)


def radars(manoeuvring: bool) -> Tracks:
    """Tracks of each pair of radars at the end."""
    x, y = np.moveaxis(sightings(), -1, 0)  # (K, B, 2)
    r2 = x**2 + y**2
    H = np.zeros((*x.shape, 2, 4))
    H[..., 0, 0], H[..., 0, 2] = x / np.sqrt(r2), y / np.sqrt(r2)
    H[..., 1, 0], H[..., 1, 2] = -y / r2, x / r2
    F, Q = planar(RADAR.period, TRACKER.motion.q)
    R = np.tile(np.diag([RADAR.sigma_range**2, RADAR.sigma_azimuth**2]), (2, 1, 1))
    B = H.shape[1]
    inverse = np.linalg.inv(H[0][..., [0, 2]])
    P = np.zeros((B, 2, 4, 4))
    P[..., ::2, ::2] = inverse @ R @ inverse.swapaxes(-1, -2)
    P[..., 1::2, 1::2] = TRACKER.sigma_speed**2 * np.eye(2)
    J = blocks(P).reshape(B, 2, 4, 2, 4)
    J[:, 0, 1::2, 1, 1::2] = J[:, 1, 1::2, 0, 1::2] = TRACKER.sigma_speed**2 * np.eye(2)
    model = Model(F, Q, H[0], R, Q if manoeuvring else np.zeros((4, 4)))
    return filtered(Tracks(P, J.reshape(B, 8, 8)), model, len(H) - 1, H[1:])


def scenarios() -> dict[str, Tracks]:
    """By name."""
    found = {}
    for index in (0.001, 0.1, 10.0):
        for ratio in (1, 3):
            found[f"process noise, index {index:g}, 1:{ratio}"] = steady(positions(1.0, index, (1.0, ratio)))
    found["process noise, index 0.1, 1:2:3"] = steady(positions(1.0, 0.1, (1.0, 2.0, 3.0)))
    found["each scan a new velocity, index 100, 1:1"] = steady(positions(1.0, 100.0, (1.0, 1.0)))
    common, still = steady(positions(1.0, 0.1, (1.0, 1.0))).P[0, 0], positions(1.0, 0.0, (1.0, 1.0))
    for k in (1, 3, 10, 30):
        found[f"common prior, {k} own measurement{'s' * (k > 1)}"] = filtered(alike(common, 2), still, k)
    new = positions(1.0, 0.1, (1.0, 1.0))
    found["memory, naive and naive"] = remembered(new, "naive", 0.0)
    found["memory, ci and bci 0.5"] = remembered(new, "ci", 0.5)
    found["memory, ci and ci"] = remembered(new, "ci", 1.0)
    G = np.kron(np.eye(2), np.array([[0.5], [1.0]]))
    li = positions(1.0, 0.0, (20.0, 40.0))._replace(Q=25.0 * G @ G.T)
    start = np.diag([500.0, 50.0, 500.0, 50.0])
    found["Li-AA, no feedback"] = filtered(alike(start, 2), li, 60)
    for rule in ("naive", "ci"):
        found[f"Li-AA, feedback of {rule}"] = fed_back(li, start, rule, 60)
    eye = np.eye(2)
    sharma = Model(
        np.array([[1.0, 0.5], [0.0, 1.0]]),
        0.5 * eye,
        np.stack([eye, eye]),
        np.stack([np.diag([0.5, 0.2]), np.diag([0.1, 0.5])]),
    )
    P0 = alike(np.array([[2.0, 1.0], [1.0, 2.0]]), 2)
    found["Sharma 6.3, independent starts"] = filtered(Tracks(P0.P, independent(P0.P)), sharma, 5)
    found["Sharma 6.3, one start"] = filtered(P0, sharma, 5)
    found["radars, straight"], found["radars, manoeuvring"] = radars(False), radars(True)
    ferry = positions(1.0, 0.05, (3.0, 4.0))
    found["navigation exact"] = steady(ferry)
    for sigma in (1.0, 3.0):
        for seconds in (0.0, 60.0):
            model = ferry._replace(shared=sigma, decay=float(np.exp(-1.0 / seconds)) if seconds else 0.0)
            word = f"over {seconds:g} s" if seconds else "white"
            found[f"navigation {sigma:g} m, {word}"] = steady(model, 400)
    return found


def in_position(tracks: Tracks) -> Tracks:
    """The tracks' positions alone."""
    B, N, n, _ = tracks.P.shape
    J = tracks.J.reshape(B, N, n, N, n)[:, :, ::2, :, ::2]
    return Tracks(tracks.P[..., ::2, ::2], J.reshape(B, N * n // 2, -1))


def by_derived(rule: str, tracks: Tracks, best: Floats) -> tuple[float, float, float]:
    """As `outcome`, of a rule that is told what is derived."""
    B, N, n, _ = tracks.P.shape
    derived = np.zeros((B, N, N, n, n)) if tracks.derived is None else tracks.derived
    left = np.linalg.cholesky(tracks.P) if tracks.left is None else tracks.left
    W = np.linalg.inv(np.linalg.cholesky(tracks.P))
    one = np.linalg.norm(W @ left, axis=(-2, -1))
    unknown = np.minimum(one[:, :, None] * one[:, None], 1.0)  # symmetric
    known = np.linalg.norm(W[:, :, None] @ derived @ W[:, None].swapaxes(-1, -2), 2, axis=(-2, -1))
    R = np.minimum(np.maximum(known, known.swapaxes(1, 2)) + unknown, 1.0)
    R[:, range(N), range(N)], unknown[:, range(N), range(N)] = 1.0, 0.0
    units = np.eye(N * n).reshape(N * n, 1, N, n)
    means, P = np.broadcast_to(units, (N * n, B, N, n)), np.broadcast_to(tracks.P, (N * n, *tracks.P.shape))
    fused = fuse("bci", means, P, max_correlation=np.broadcast_to(R, (N * n, *R.shape)))
    gains, reported = fused.mean, fused.covariance[0]
    exact = (unknown < ENOUGH).all(axis=(1, 2)) & (rule == "bar-shalom-campo")
    for b in np.flatnonzero(exact):
        cross = 0.5 * (derived[b] + derived[b].transpose(1, 0, 3, 2))
        best_linear = fuse("bar-shalom-campo", means[:, b], P[:, b], cross_covariance=cross)
        gains[:, b], reported[b] = best_linear.mean, best_linear.covariance[0]
    true = mse(gains.reshape(N, n, B, n).transpose(2, 0, 3, 1), tracks.J)
    variances = (float((np.trace(A[:, ::2, ::2], axis1=1, axis2=2) / best).mean()) for A in (reported, true))
    return (*variances, float(excess(true, reported).max()))  # type: ignore[return-value]


def outcome(rule: Fuser, tracks: Tracks, best: Floats, rng: np.random.Generator, runs: int) -> Floats:
    """Reported and true variance of position relative to the optimum's (mean), excess (largest): (3, groups)."""
    B, N, n, _ = tracks.P.shape
    several = []
    for _ in range(GROUPS):
        error, claimed, _, constant = expected(
            rule, tracks.P, tracks.J, draws(rng, (N - 1) * n, max(1, runs // GROUPS // B))
        )
        variances = (np.trace(A[:, ::2, ::2], axis1=1, axis2=2) for A in (claimed, error))
        several.append([*((v / best).mean() for v in variances), excess(error, claimed).max()])
        if constant:
            break
    return np.array(several).T


def run(run: Run) -> Result:
    rules = (
        fuser("naive"),
        fuser("ci"),
        replace(fuser("bci"), label=OWN_BOUND),
        fuser("bci:max_correlation=0.5"),
        fuser("ici"),
        fuser("hmd-ga"),
        *run.rules,
    )
    cases = scenarios()
    rows: dict[str, list[Row]] = {"correlation": [], "reported": [], "true": [], "excess": []}
    heads = ("reported variance of position / optimum", "true variance of position / optimum", "excess")
    for number, (name, tracks) in enumerate(cases.items()):
        bound = float(largest_correlation(tracks.J, tracks.P).max())
        _, N, n, _ = tracks.P.shape
        own = np.stack([tracks.J[:, i * n : (i + 1) * n, i * n : (i + 1) * n] for i in range(N)], axis=1)
        place = in_position(tracks)
        rows["correlation"] += [
            Row(name, "correlation: largest", None, bound),
            Row(name, "correlation: largest in position", None, float(largest_correlation(place.J, place.P).max())),
            Row(name, "correlation: a track's own true / reported", None, float(excess(own, tracks.P).max())),
        ]
        best = np.trace(optimal(tracks.J, n)[:, ::2, ::2], axis1=1, axis2=2)
        for rule in rules:
            if rule.label == OWN_BOUND:
                rule = replace(rule, options=(("max_correlation", min(1.0, bound)),))
            answer = outcome(rule, tracks, best, run.rng(number), run.runs)
            for which, head, samples in zip(("reported", "true", "excess"), heads, answer, strict=True):
                error = float(samples.std(ddof=1) / np.sqrt(len(samples))) if len(samples) > 1 else 0.0
                quantity = f"{head}: {rule.label}"
                rows[which].append(Row(name, quantity, None, float(samples.mean()), error if error > 1e-9 else None))
        for known in DERIVED:
            for which, head, value in zip(
                ("reported", "true", "excess"), heads, by_derived(known, tracks, best), strict=True
            ):
                rows[which].append(Row(name, f"{head}: {known} derived", None, value))
        run.progress((number + 1) / len(cases), name)
    return Result(
        tuple(row for group in rows.values() for row in group), _notes(rows), partial(_draw, rows), (12.0, 8.5)
    )


def _notes(rows: dict[str, list[Row]]) -> tuple[str, ...]:
    value = {(row.name, row.quantity.partition(": ")[2]): row.ours for row in rows["correlation"]}
    over = {(row.name, row.quantity.partition(": ")[2]): row.ours for row in rows["excess"]}
    true = {(row.name, row.quantity.partition(": ")[2]): row.ours for row in rows["true"]}

    def of(start: str, what: str = "largest", table: dict[tuple[str, str], float] = value) -> str:
        found = sorted(one for (name, which), one in table.items() if name.startswith(start) and which == what)
        low, high = f"{found[0]:.2f}", f"{found[-1]:.2f}"
        return low if low == high else f"{low} to {high}"

    own = "a track's own true / reported"
    best, bound = (f"{rule} derived" for rule in DERIVED)
    worst_of = partial(of, table=over)
    naive = max(one for (name, rule), one in true.items() if name.startswith("process") and rule == "naive")
    tight = sum(abs(one - 1.0) < 5e-3 for (_, rule), one in over.items() if rule == OWN_BOUND)
    number = len({name for name, _ in over})
    return (
        f"Common process noise alone gives {of('process noise')} at these indices and ratios, though only "
        f"{of('process noise', 'largest in position')} in position: it is combinations with velocity that are "
        f"correlated. The naive rule's position is within {100 * (naive - 1):.0f} % of the optimum in variance, but "
        f"its covariance is too small by a factor of {of('process noise', 'naive', over)} in some direction. "
        "`max_correlation = 0.85` holds for all of these, for the manoeuvring radars "
        f"({of('radars, manoeuvring')}) and for Li-AA without feedback ({of('Li-AA, no feedback')}). It does not "
        f"where each scan finds a new velocity ({of('each scan')} at index 100).",
        f"Targets as straight as Sharma's, whatever process noise the filters allow for ({of('radars, straight')}): "
        "errors as good as independent. Naive fusion is right there, as long as none turns.",
        f"A common prior starts at 1 and is forgotten by own measurements, without process noise: "
        f"{of('common prior, 3 ')} after three, {of('common prior, 10 ')} after ten, {of('common prior, 30 ')} after "
        f"thirty. Velocity remembers it longest (in position {of('common prior, 3 ', 'largest in position')} after "
        "three). With process noise and fast filters (Sharma 6.3: "
        f"{of('Sharma')}) five steps are enough, and the start does not matter.",
        f"A fused result that is used again has {of('memory, ci')} in common with the fusion of new local tracks, and "
        f"filters that go on from one fused result {of('Li-AA, feedback of ci')}: keep the bound at 1, as the centre's "
        "`memory_correlation` is by default.",
        "A bound on the correlation is no help for tracks that understate their own error. Naive memory or feedback, "
        "and a navigation error that lasts longer than the filters' memory, make such tracks: the variance in some "
        f"direction is {of('memory, naive', own)}, {of('Li-AA, feedback of naive', own)} and "
        f"{of('navigation 1 m, over', own)} (at 1 m) or {of('navigation 3 m, over', own)} (at 3 m) times the reported "
        "one, and no rule here is conservative. Such a common error belongs into the reported covariances, or into "
        "the state. One that is new at each scan, and allowed for, only raises the correlation "
        f"({of('navigation 1 m, white')} and {of('navigation 3 m, white')} from {of('navigation exact')}).",
        "Derived from the tracks alone: where filters are what they say and targets move as they allow for, "
        f"`bar-shalom-campo` has an excess of {worst_of('process', best)} and the optimum's variance, reported and "
        f"true, and `bci` {worst_of('process', bound)}. A common prior is no trap: nothing is taken as known until it "
        "is forgotten. What it cannot see is an error common to the measurements: new at each scan, "
        f"{worst_of('navigation 1 m, white', best)} and {worst_of('navigation 3 m, white', best)} (`bci` "
        f"{worst_of('navigation 1 m, white', bound)} and {worst_of('navigation 3 m, white', bound)}); lasting, "
        f"{worst_of('navigation 1 m, over', best)} and {worst_of('navigation 3 m, over', best)}. Sources with such an "
        "error are one correlation group, under a declared bound.",
        f"`bci` at a scenario's own correlation has an excess of 1.00 in {tight} of {number} scenarios: the worst "
        "case under the bound is what occurs.",
    )


def _draw(rows: dict[str, list[Row]], figure: Any) -> None:
    grid = figure.add_gridspec(2, 2, width_ratios=(2, 3))
    above, below, right = (figure.add_subplot(grid[where]) for where in ((0, 0), (1, 0), (slice(None), 1)))
    indices = np.geomspace(1e-4, 1e2, 13)
    for ratio, shade in ((1, "#0072b2"), (3, "#e69f00"), (10, "#009e73")):
        tracks = [steady(positions(1.0, index, (1.0, ratio))) for index in indices]
        whole = [largest_correlation(one.J, one.P)[0] for one in tracks]
        place = [largest_correlation(p.J, p.P)[0] for p in map(in_position, tracks)]
        above.semilogx(indices, whole, color=shade, label=f"1:{ratio}")
        above.semilogx(indices, place, "--", color=shade)
    above.set(xlabel="index q T³ / σ²", ylabel="largest correlation", ylim=(0, 1))
    above.set_title("Common process noise (dashed: position)", fontsize=10)
    above.legend(title="σ1:σ2", fontsize=8, loc="upper left", bbox_to_anchor=(0.0, 0.6), ncols=3)
    common, still = steady(positions(1.0, 0.1, (1.0, 1.0))).P[0, 0], positions(1.0, 0.0, (1.0, 1.0))
    counts = np.array([1, 2, 3, 5, 8, 12, 20, 30, 50])
    tracks = [filtered(alike(common, 2), still, k) for k in counts]
    below.plot(counts, [largest_correlation(one.J, one.P)[0] for one in tracks], color="#cc79a7", label="state")
    place = [largest_correlation(p.J, p.P)[0] for p in map(in_position, tracks)]
    below.plot(counts, place, "--", color="#cc79a7", label="position")
    below.set(xlabel="own measurements since", ylabel="largest correlation", ylim=(0, 1.03))
    below.set_title("A common prior is forgotten", fontsize=10)
    below.legend(fontsize=8)
    names = list(dict.fromkeys(row.name for row in rows["excess"]))
    rules = list(dict.fromkeys(row.quantity.partition(": ")[2] for row in rows["excess"]))
    for row in rows["excess"]:
        rule = row.quantity.partition(": ")[2]
        height = names.index(row.name) + 0.7 * (rules.index(rule) / (len(rules) - 1) - 0.5)
        marker = {"bci": "D", "bci:max_correlation=0.5": "x", "bci derived": "s", "bar-shalom-campo derived": "*"}.get(
            rule, "o"
        )
        label = rule if row.name == names[0] else None
        right.plot(row.ours, height, marker, color=pictures.colour(rule), ms=4, label=label)
    right.axvline(1.0, color="#000000", lw=0.8)
    right.set_xscale("log")
    right.xaxis.set_major_formatter("{x:g}")
    right.set_yticks(range(len(names)), names, fontsize=8)
    right.set_ylim(len(names) - 0.5, -0.5)
    for k in range(1, len(names)):
        right.axhline(k - 0.5, color="#cccccc", lw=0.5)
    right.set(xlabel="excess: largest eigenvalue of MSE / reported")
    right.set_title("What the rules make of it", fontsize=10)
    right.legend(fontsize=8, loc="lower right")


STUDIES = (
    Study(
        name="track-correlation",
        title="How correlated local tracks are, and what each rule makes of it",
        source="our own",
        about=__doc__ or "",
        run=run,
        runs=4_000,
        quick=400,
        seconds=5.0,
        takes_rules=True,
        widest=8,
    ),
)
